"""Messages through the two directions of a recorded path: first in, first out, at the recorded rate."""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right
from itertools import pairwise
from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    import random
    from collections.abc import Sequence

PACKET_BYTES = 1400
"""What one packet carries of a message."""

_BYTES_PER_KBIT = 125.0


class Direction(Protocol):
    """What one direction of a path does in one step: `controlplane.planning.traces.Direction`, or a link of the lab."""

    @property
    def rate_kbps(self) -> float | None:
        """Kilobit/s; 0 is an outage, as is None: a recorded path has a rate."""

    @property
    def delay_ms(self) -> float:
        """Propagation, one way."""

    @property
    def loss(self) -> float:
        """Probability that a packet is lost."""

    @property
    def queue_bytes(self) -> int:
        """Room in front of the bottleneck."""


class Step(Protocol):
    """From `at_s` seconds on, both directions are like this."""

    @property
    def at_s(self) -> float:
        """Seconds from the start."""

    @property
    def up(self) -> Direction:
        """From the robot."""

    @property
    def down(self) -> Direction:
        """To the robot."""


class FifoLink:
    """One direction. Messages are offered in order of time; times are seconds of the trace's clock."""

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
        """Capacity used up when all that was accepted has left."""
        self._last_arrival = 0.0

    def _step(self, at: float) -> int:
        return max(0, bisect_right(self._starts, at) - 1)

    def capacity_by(self, at: float) -> float:
        """Bytes that could have left by then, since the trace's start."""
        step = self._step(at)
        return self._capacity[step] + self._rates[step] * (at - self._starts[step])

    def time_of(self, capacity: float) -> float:
        """When so many bytes could have left; inf if the trace ends before."""
        step = bisect_left(self._capacity, capacity) - 1
        if step < 0:
            return 0.0
        rate = self._rates[step]
        return self._starts[step] + (capacity - self._capacity[step]) / rate if rate else math.inf

    def delay_at(self, at: float) -> float:
        """Seconds of propagation of what leaves then."""
        return self._delays[self._step(at)]

    def send(self, at: float, size: int, rng: random.Random) -> float:
        """When a message of `size` bytes offered `at` has arrived; inf when the queue has no room for it.

        Each packet is lost with the step's probability. What is lost is sent once more, a round trip after it was
        missed; lost again, the message is lost.
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
        """Seconds from `at` to the answer; inf when request or answer is lost.

        Answers queue in the order of their requests, though a server may overtake itself by its processing time.
        """
        arrived = self.up.send(at, size, rng)
        if math.isinf(arrived):
            return math.inf
        return self.down.send(arrived + processing_s, answer_size, rng) - at
