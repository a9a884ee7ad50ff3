"""Implements the client side of every contender: sends requests open or closed loop, and logs what became of each.

A request begins with HEADER, its number and the time at which it was sent; an answer begins with the same bytes. All
clocks are CLOCK_MONOTONIC, which all processes and network namespaces of one host share: a receiver can compute
one-way times.
"""

from __future__ import annotations

import math
import os
import resource
import struct
import threading
import time
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Callable

HEADER = struct.Struct("<Qd")
"""Number of the request, and the time in seconds at which it was sent."""


@dataclass(frozen=True, slots=True)
class Plan:
    """A plan of requests to send."""

    size: int
    """Bytes of each request, at least HEADER.size."""
    count: int
    rate_hz: float | None = None
    """Requests a second, open loop; None for a closed loop with `at_once` in flight."""
    at_once: int = 1
    seconds: float = math.inf
    """Time after the first request at which sending stops, however many are left."""
    grace_s: float = 5.0
    """Longest wait for the last answers."""
    start_s: float | None = None
    """When the first request leaves, in CLOCK_MONOTONIC; None for at once."""


@dataclass(slots=True)
class CallLog:
    """Times at which each request left and its first answer came, in order of sending. Fed from several threads."""

    sent_s: list[float] = field(default_factory=list)
    latency_s: list[float | None] = field(default_factory=list)
    first: int = 0
    _missing: int = 0
    _changed: threading.Condition = field(default_factory=threading.Condition)

    def sent(self, now: float) -> None:
        """Note that the next request leaves now."""
        with self._changed:
            self.sent_s.append(now)
            self.latency_s.append(None)
            self._missing += 1

    def answered(self, header: bytes | bytearray | memoryview, now: float) -> None:
        """Note an answer; only the first to a request counts."""
        number, sent = HEADER.unpack_from(header)
        index = number - self.first
        with self._changed:
            if 0 <= index < len(self.latency_s) and self.latency_s[index] is None:
                self.latency_s[index] = now - sent
                self._missing -= 1
                self._changed.notify_all()

    def wait_until_missing(self, at_most: int, timeout_s: float) -> bool:
        """Wait until at most `at_most` requests lack an answer; return False if the time is over first."""
        with self._changed:
            return self._changed.wait_for(lambda: self._missing <= at_most, timeout_s)

    def as_json(self) -> dict[str, Any]:
        """Return what `Calls.of` reads."""
        return {"sent_s": self.sent_s, "latency_s": self.latency_s}


class Compute:
    """A server's computing: a fixed time for each request, and much more for one in `stall_every`."""

    def __init__(self, compute_s: float = 0.0, *, stall_s: float = 0.0, stall_every: int = 0) -> None:
        """Set the times; with `stall_every` 0 it never stalls."""
        self._compute_s = compute_s
        self._stall_s = stall_s
        self._stall_every = stall_every
        self._served = 0

    def next_s(self) -> float:
        """Return the seconds that the next request takes."""
        self._served += 1
        stalls = self._stall_every and self._served % self._stall_every == 0
        return self._compute_s + self._stall_s if stalls else self._compute_s

    def serve(self) -> None:
        """Spend the time that the next request takes."""
        seconds = self.next_s()
        if seconds:
            time.sleep(seconds)


class Caller:
    """Sends plans of requests through `send` and collects the answers; numbers continue from plan to plan."""

    def __init__(self, send: Callable[[int, bytes], None]) -> None:
        self._send = send
        self._log = CallLog()
        self._next = 0

    def answered(self, header: bytes | bytearray | memoryview, now: float) -> None:
        """Take an answer, which begins with `header`; may be called on any thread."""
        self._log.answered(header, now)

    def call(self, plan: Plan) -> dict[str, Any]:
        """Send the requests; return what `Calls.of` reads once all are answered or the grace is over."""
        filler = os.urandom(max(0, plan.size - HEADER.size))
        log = self._log = CallLog(first=self._next)
        start = time.monotonic() if plan.start_s is None else plan.start_s
        time.sleep(max(0.0, start - time.monotonic()))
        for position in range(plan.count):
            if plan.rate_hz is not None:
                time.sleep(max(0.0, start + position / plan.rate_hz - time.monotonic()))
            elif not log.wait_until_missing(plan.at_once - 1, plan.grace_s):
                break
            if time.monotonic() - start > plan.seconds:
                break
            number = self._next
            self._next += 1
            now = time.monotonic()
            data = HEADER.pack(number, now) + filler
            log.sent(now)
            self._send(number, data)
        log.wait_until_missing(0, plan.grace_s)
        return log.as_json()


def usage() -> dict[str, float]:
    """Return this process's processor seconds, and its peak of resident bytes."""
    peak_kb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return {"cpu_s": time.process_time(), "peak_bytes": peak_kb * 1024}
