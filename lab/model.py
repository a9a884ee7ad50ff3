"""Models one direction of an emulated link, without IO: which packets survive, and when they leave.

    send ──▶ loss ──▶ byte queue ──▶ bottleneck (rate) ──▶ propagation (delay + jitter) ──▶ pop_due
              │           │ full: newest dropped
              ▼           ▼
            counters by DropReason

The loss is drawn as the packet is sent, so a lost packet takes no room and no air time. Two draws
are made for every packet, needed or not: the fate of the n-th packet depends only on the seed and the
profile in force, never on the draws of earlier profiles.
"""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING

from lab.profile import DropReason, LinkProfile

if TYPE_CHECKING:
    from random import Random

# Most packets in propagation that one direction stores; ~150 MB at the usual MTU, 1 s at 100 kpps.
MAX_IN_FLIGHT_PACKETS = 100_000


class LinkModel:
    """Queue, loss, rate and delay of one direction. Times are monotonic seconds and never go back."""

    def __init__(self, profile: LinkProfile, rng: Random, now: float = 0.0) -> None:
        self.sent_packets = 0
        self.sent_bytes = 0
        self.delivered_packets = 0
        self.delivered_bytes = 0
        self.drops: dict[DropReason, int] = dict.fromkeys(DropReason, 0)
        self._rng = rng
        self._queue: deque[tuple[bytes, int, float]] = deque()  # packet, size, its draw for the jitter
        self._queue_bytes = 0
        self._head_bits = 0.0  # bits of the queue's head still to be serialised
        self._head_since = now  # when the bottleneck began with those bits
        self._in_flight: deque[tuple[float, bytes, int]] = deque()  # departure, packet, size
        self._last_due = now
        self._dark: DropReason | None = None
        self._apply(profile)

    @property
    def profile(self) -> LinkProfile:
        """The profile in force."""
        return self._profile

    @property
    def queue_bytes(self) -> int:
        """Bytes in front of the bottleneck at the last call with a time."""
        return self._queue_bytes

    @property
    def in_flight_packets(self) -> int:
        """Packets that have passed the bottleneck but not left."""
        return len(self._in_flight)

    def send(self, now: float, packet: bytes, size: int) -> None:
        """Hand in a packet of `size` bytes (as the rate counts them); it may be dropped and counted."""
        random = self._rng.random
        loss_draw = random()
        jitter_draw = random()
        self.sent_packets += 1
        self.sent_bytes += size
        if self._dark is not None:
            self.drops[self._dark] += 1
            return
        if loss_draw < self._loss:
            self.drops[DropReason.LOSS] += 1
            return
        if self._bits_per_s is None:
            self._propagate(now, packet, size, jitter_draw)
            return
        self._advance(now)
        if self._queue_bytes + size > self._profile.queue_bytes:
            self.drops[DropReason.QUEUE_FULL] += 1
            return
        if not self._queue:
            self._head_bits = size * 8.0
            self._head_since = now
        self._queue.append((packet, size, jitter_draw))
        self._queue_bytes += size

    def next_departure(self) -> float | None:
        """Return when `pop_due` will next have a packet, if nothing else happens; None if never."""
        if self._in_flight:
            return self._in_flight[0][0]
        if self._queue and self._bits_per_s:
            done = self._head_since + self._head_bits / self._bits_per_s
            due = done + self._delay_s + self._jitter_s * self._queue[0][2]
            return due if due > self._last_due else self._last_due
        return None

    def pop_due(self, now: float) -> list[tuple[float, bytes]]:
        """Return (departure time, packet) of every packet due by `now`, in the order they were sent."""
        if self._queue:
            self._advance(now)
        in_flight = self._in_flight
        due: list[tuple[float, bytes]] = []
        while in_flight and in_flight[0][0] <= now:
            at, packet, size = in_flight.popleft()
            due.append((at, packet))
            self.delivered_packets += 1
            self.delivered_bytes += size
        return due

    def set_profile(self, now: float, profile: LinkProfile) -> None:
        """Change the profile; packets already past the bottleneck keep their departure times.

        A queue longer than the new `queue_bytes` keeps its packets and takes no more.
        """
        self._advance(now)
        if self._queue and self._bits_per_s:
            served = (now - self._head_since) * self._bits_per_s
            self._head_bits = max(0.0, self._head_bits - served)
        self._head_since = now
        self._apply(profile)
        if self._bits_per_s is None:
            while self._queue:
                self._leave_queue(now)

    def set_dark(self, now: float, reason: DropReason | None) -> None:
        """Lose everything from `now` on, including packets queued or in flight, until set to None."""
        self._advance(now)
        self._dark = reason
        if reason is not None:
            self.drops[reason] += len(self._queue) + len(self._in_flight)
            self._queue.clear()
            self._queue_bytes = 0
            self._in_flight.clear()
            self._last_due = now

    def count_undeliverable(self, packet_bytes: int) -> None:
        """Count a packet from `pop_due` that could not be handed to the receiving interface after all."""
        self.delivered_packets -= 1
        self.delivered_bytes -= packet_bytes
        self.drops[DropReason.INTERFACE_DOWN] += 1

    def _apply(self, profile: LinkProfile) -> None:
        self._profile = profile
        self._loss = profile.loss
        self._bits_per_s = None if profile.rate_kbps is None else profile.rate_kbps * 1000.0
        self._delay_s = profile.delay_ms / 1000.0
        self._jitter_s = profile.jitter_ms / 1000.0

    def _advance(self, now: float) -> None:
        """Let the bottleneck work up to `now`."""
        if not self._bits_per_s:
            return
        while self._queue:
            done = self._head_since + self._head_bits / self._bits_per_s
            if done > now:
                return
            self._leave_queue(done)

    def _leave_queue(self, done: float) -> None:
        packet, size, jitter_draw = self._queue.popleft()
        self._queue_bytes -= size
        self._head_since = done
        if self._queue:
            self._head_bits = self._queue[0][1] * 8.0
        self._propagate(done, packet, size, jitter_draw)

    def _propagate(self, start: float, packet: bytes, size: int, jitter_draw: float) -> None:
        if len(self._in_flight) >= MAX_IN_FLIGHT_PACKETS:
            self.drops[DropReason.IN_FLIGHT_FULL] += 1
            return
        due = start + self._delay_s + self._jitter_s * jitter_draw
        if due < self._last_due:
            due = self._last_due
        else:
            self._last_due = due
        self._in_flight.append((due, packet, size))
