"""Runs one emulated link as a process: frames go from one port, through a `LinkModel`, to the other port.

Requests arrive as JSON lines on an inherited socket, each answered by one line:

    {"op": "set", "up": PROFILE | null, "down": PROFILE | null}   ends a replay
    {"op": "dark", "reason": "blackhole" | "unplugged" | null}
    {"op": "replay", "start": MONOTONIC_S, "steps": [[AT_S, UP, DOWN], ...], "repeat_s": S | null}
    {"op": "stats", "reset": bool}                                 counters, lateness, process time
"""

from __future__ import annotations

import gc
import os
import select
import time
from dataclasses import dataclass
from random import Random
from typing import TYPE_CHECKING, Any

from lab import kernel
from lab.errors import LabConfigError, LabError
from lab.lateness import LatenessHistogram
from lab.model import LinkModel
from lab.profile import DropReason, LinkProfile
from lab.replay import Replay
from lab.traces import TraceStep

if TYPE_CHECKING:
    from lab.ports import Port
    from lab.wire import LineSocket

_ETHERNET_HEADER_BYTES = 14
# Frames taken from one port before the other port, the timers and the requests get a turn.
_BATCH_FRAMES = 64
# The emulator shares its cores with what it measures, and a late emulator falsifies every figure. With two cores and
# three busy processes, its worst lateness was 0.2 ms at this priority, 4 ms at niceness -10, 3 ms at 0.
_REALTIME_PRIORITY = 1


@dataclass(slots=True)
class _Direction:
    source: Port
    sink: Port
    model: LinkModel
    bypassed: int = 0


class LinkEmulator:
    """Moves frames between the ports `inner` (the host's) and `outer` (towards the internet)."""

    def __init__(
        self, inner: Port, outer: Port, control: LineSocket, *, up: LinkProfile, down: LinkProfile, seed: str
    ) -> None:
        now = time.monotonic()
        self._inner = inner
        self._outer = outer
        self._control = control
        self._up = _Direction(inner, outer, LinkModel(up, Random(f"{seed}/up"), now))
        self._down = _Direction(outer, inner, LinkModel(down, Random(f"{seed}/down"), now))
        self._replay: Replay | None = None
        self._dark: DropReason | None = None
        self._lateness = LatenessHistogram()
        self._step_lateness = LatenessHistogram()
        self._turns = 0
        self._realtime = True
        self._longest_turn_s = 0.0

    def run(self) -> None:
        """Emulate until the control socket closes."""
        kernel.set_timer_slack(1)
        try:
            os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(_REALTIME_PRIORITY))
        except PermissionError:
            self._realtime = False
        gc.freeze()
        gc.disable()  # frames create no cycles, and a collection would delay every timer
        directions = (self._up, self._down)
        sources = {direction.source.fileno(): direction for direction in directions}
        control = self._control.fileno()
        watched = [*sources, control]
        monotonic = time.monotonic
        while True:
            readable, _, _ = select.select(watched, (), (), self._timeout(monotonic()))
            now = monotonic()
            if self._replay is not None:
                self._apply_replay(now)
            for descriptor in readable:
                if descriptor == control:
                    if not self._serve():
                        return
                else:
                    self._take(sources[descriptor], now)
            for direction in directions:
                self._deliver(direction)
            self._turns += 1
            self._longest_turn_s = max(self._longest_turn_s, monotonic() - now)

    def _timeout(self, now: float) -> float | None:
        times = [self._up.model.next_departure(), self._down.model.next_departure()]
        if self._replay is not None:
            times.append(self._replay.next_change())
        due = [at for at in times if at is not None]
        return max(0.0, min(due) - now) if due else None

    def _take(self, direction: _Direction, now: float) -> None:
        read = direction.source.read
        send = direction.model.send
        for _ in range(_BATCH_FRAMES):
            frame = read()
            if frame is None:
                return
            if frame[0] & 1:
                # Multicast and broadcast are the kernel's own ARP and MLD. No router forwards them, and
                # they must not use up draws that decide the fate of the traffic under test.
                if self._dark is None:
                    direction.bypassed += 1
                    direction.sink.write(frame)
                continue
            send(now, frame, len(frame) - _ETHERNET_HEADER_BYTES)

    def _deliver(self, direction: _Direction) -> None:
        monotonic = time.monotonic
        for due, frame in direction.model.pop_due(monotonic()):
            if not direction.sink.write(frame):
                direction.model.count_undeliverable(len(frame) - _ETHERNET_HEADER_BYTES)
            self._lateness.record(monotonic() - due)

    def _apply_replay(self, now: float) -> None:
        if self._replay is None:
            return
        for at, step in self._replay.due(now):
            self._step_lateness.record(now - at)
            self._up.model.set_profile(now, step.up)
            self._down.model.set_profile(now, step.down)

    def _serve(self) -> bool:
        messages = self._control.receive_ready()
        if messages is None:
            return False
        for message in messages:
            try:
                answer = {"ok": True, **self._answer(message)}
            except (LabConfigError, LabError, OSError, KeyError, TypeError) as error:
                answer = {"ok": False, "error": f"{type(error).__name__}: {error}"}
            self._control.send(answer)
        return True

    def _answer(self, message: dict[str, Any]) -> dict[str, Any]:
        now = time.monotonic()
        match message["op"]:
            case "set":
                self._replay = None
                for direction, profile in ((self._up, message["up"]), (self._down, message["down"])):
                    if profile is not None:
                        direction.model.set_profile(now, LinkProfile.from_json(profile))
                return {}
            case "dark":
                self._set_dark(now, message["reason"])
                return {}
            case "replay":
                steps = tuple(TraceStep.from_json(step) for step in message["steps"])
                self._replay = Replay(steps, start=message["start"], repeat_s=message["repeat_s"])
                self._apply_replay(now)
                return {}
            case "stats":
                return self._statistics(reset=message["reset"])
            case other:
                raise LabError(f"no such request: {other!r}")

    def _set_dark(self, now: float, reason: str | None) -> None:
        unplugged = self._dark is DropReason.UNPLUGGED
        self._dark = None if reason is None else DropReason(reason)
        for direction in (self._up, self._down):
            direction.model.set_dark(now, self._dark)
        if unplugged != (self._dark is DropReason.UNPLUGGED):
            for port in (self._inner, self._outer):
                port.set_carrier(on=unplugged)

    def _statistics(self, *, reset: bool) -> dict[str, Any]:
        statistics = {
            "up": _counters(self._up),
            "down": _counters(self._down),
            "dark": self._dark,
            "replaying": self._replay is not None,
            "lateness": self._lateness.to_json(),
            "step_lateness": self._step_lateness.to_json(),
            "turns": self._turns,
            "realtime": self._realtime,
            "longest_turn_s": self._longest_turn_s,
            "cpu_s": time.process_time(),
        }
        if reset:
            self._lateness = LatenessHistogram()
            self._step_lateness = LatenessHistogram()
            self._longest_turn_s = 0.0
        return statistics


def _counters(direction: _Direction) -> dict[str, Any]:
    model = direction.model
    return {
        "sent_packets": model.sent_packets,
        "sent_bytes": model.sent_bytes,
        "delivered_packets": model.delivered_packets,
        "delivered_bytes": model.delivered_bytes,
        "drops": {reason.value: count for reason, count in model.drops.items()},
        "queue_bytes": model.queue_bytes,
        "in_flight_packets": model.in_flight_packets,
        "bypassed_packets": direction.bypassed,
        "kernel_drops": direction.source.kernel_drops(),
        "profile": model.profile.to_json(),
    }
