"""Sends messages through the two directions of a recorded path: first in, first out, at the recorded rate."""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right
from itertools import pairwise
from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    import random
    from collections.abc import Sequence

PACKET_BYTES = 1400
"""Payload of one packet."""

_BYTES_PER_KBIT = 125.0


class Direction(Protocol):
    """One direction of a path during one step: `plr.controlplane.planning.traces.Direction`, or a link of the lab."""

    @property
    def rate_kbps(self) -> float | None:
        """Rate in kilobit/s; 0 is an outage, and so is None, since a recorded path has a rate."""

    @property
    def delay_ms(self) -> float:
        """One-way propagation delay in milliseconds."""

    @property
    def loss(self) -> float:
        """Probability that a packet is lost."""

    @property
    def queue_bytes(self) -> int:
        """Size in bytes of the queue in front of the bottleneck."""


class Step(Protocol):
    """The state of both directions from `at_s` seconds on."""

    @property
    def at_s(self) -> float:
        """Seconds from the start."""

    @property
    def up(self) -> Direction:
        """Direction from the robot."""

    @property
    def down(self) -> Direction:
        """Direction to the robot."""


class FifoLink:
    """One direction of a path. Messages must be sent in order of time; times are seconds of the trace's clock."""

    def __init__(self, steps: Sequence[Step], *, up: bool) -> None:
        profiles = [step.up if up else step.down for step in steps]
        self._starts = [step.at_s for step in steps]
        self._rates = [(profile.rate_kbps or 0.0) * _BYTES_PER_KBIT for profile in profiles]
        self._delays = [profile.delay_ms / 1e3 for profile in profiles]
        self._losses = [profile.loss for profile in profiles]
        self._queue_bytes = profiles[0].queue_bytes
        self._capacity = [0.0]
        """Bytes that could have left by the start of each step."""
        for rate, (start, end) in zip(self._rates, pairwise(self._starts), strict=False):
            self._capacity.append(self._capacity[-1] + rate * (end - start))
        self._work = 0.0
        """Capacity used up once all accepted messages have left."""
        self._last_arrival = 0.0

    def _step(self, at: float) -> int:
        return max(0, bisect_right(self._starts, at) - 1)

    def capacity_by(self, at: float) -> float:
        """Return the bytes that could have left between the trace's start and `at`."""
        step = self._step(at)
        return self._capacity[step] + self._rates[step] * (at - self._starts[step])

    def time_of(self, capacity: float) -> float:
        """Return when `capacity` bytes could have left; inf if the trace ends before."""
        step = bisect_left(self._capacity, capacity) - 1
        if step < 0:
            return 0.0
        rate = self._rates[step]
        return self._starts[step] + (capacity - self._capacity[step]) / rate if rate else math.inf

    def rate_at(self, at: float) -> float:
        """Return the rate at that time in bytes a second."""
        return self._rates[self._step(at)]

    def delay_at(self, at: float) -> float:
        """Return the propagation delay in seconds of a packet that leaves `at` that time."""
        return self._delays[self._step(at)]

    def send(self, at: float, size: int, rng: random.Random) -> float:
        """Return when a message of `size` bytes sent `at` has arrived; inf if it is lost or the queue has no room.

        Each packet is lost with the step's probability. A lost packet is sent again, a round trip after it left. If
        it is lost again, the message is lost.
        """
        used = max(self._work, self.capacity_by(at))
        if used - self.capacity_by(at) + size > self._queue_bytes:
            return math.inf
        self._work = used + size
        left = self.time_of(self._work)
        if math.isinf(left):
            return math.inf
        delay = self.delay_at(left)
        arrived = left + delay
        packets = -(-size // PACKET_BYTES)
        lost = self._lost(at, packets, rng)
        if lost:
            again = left + 2.0 * delay
            if self._lost(again, lost, rng):
                return math.inf
            arrived = again + self.delay_at(again)
        self._last_arrival = max(self._last_arrival, arrived)
        return self._last_arrival

    def _lost(self, at: float, packets: int, rng: random.Random) -> int:
        loss = self._losses[self._step(at)]
        return sum(rng.random() < loss for _ in range(packets)) if loss else 0


class FifoPath:
    """Both directions of one path to a server."""

    def __init__(self, steps: Sequence[Step]) -> None:
        self.up = FifoLink(steps, up=True)
        self.down = FifoLink(steps, up=False)

    def request(self, at: float, size: int, answer_size: int, processing_s: float, rng: random.Random) -> float:
        """Return the seconds from `at` to the answer; inf if request or answer is lost.

        Answers queue in the order of their requests, even if a server with varying processing time would reorder them.
        """
        arrived = self.up.send(at, size, rng)
        if math.isinf(arrived):
            return math.inf
        return self.down.send(arrived + processing_s, answer_size, rng) - at
