"""Tracks the packet numbers received on one path, and the acknowledgement owed for them."""

from __future__ import annotations

from plr.sidecar.core.wire.frame import MAX_ACK_RANGES

MAX_ACK_DELAY_S = 0.005
"""Longest time that a lone datagram's acknowledgement waits for something to travel with."""
ACK_EVERY = 4
"""Ack-eliciting datagrams that trigger an acknowledgement at once. RFC 9000 (section 13.2.2) says two, but allows
others: each acknowledgement costs both ends about as much processor time as a datagram. With eight, the rate of bursts
is seen too late, and 17 ms of queue instead of 12 stand in a 20 Mbit/s link."""
STALE_PACKETS = 1024
"""Ranges this far below the largest are no longer reported: the sender has long declared their gaps lost."""


class ReceivedPackets:
    """The packet numbers that came, as at most MAX_ACK_RANGES inclusive ranges, highest first."""

    __slots__ = ("_floor", "_gap", "_largest_at", "_ranges", "_unacked", "ack_at")

    def __init__(self) -> None:
        self._ranges: list[list[int]] = []
        self._floor = -1
        """Everything up to here counts as received: it may have been, but its range is forgotten."""
        self._largest_at = 0.0
        self.ack_at: float | None = None
        """When the acknowledgement is due; None when nothing is owed."""
        self._unacked = 0
        self._gap = False

    @property
    def largest(self) -> int:
        """The largest packet number that came; -1 before the first."""
        return self._ranges[0][1] if self._ranges else -1

    def add_run(self, low: int, high: int, now: float) -> None:
        """Note consecutive packet numbers, all of them larger than any before."""
        ranges = self._ranges
        if ranges and low == ranges[0][1] + 1:
            ranges[0][1] = high
        else:
            self._gap = self._gap or bool(ranges)
            ranges.insert(0, [low, high])
            while len(ranges) > MAX_ACK_RANGES or ranges[-1][1] < high - STALE_PACKETS:
                self._floor = ranges.pop()[1]
        self._largest_at = now

    def add(self, number: int, now: float) -> bool:
        """Note a packet number; return False if it came before or is older than what is remembered."""
        if number > self.largest:
            self.add_run(number, number, now)
            return True
        if number <= self._floor or not self._fill(number):
            return False
        self._gap = True
        return True

    def _fill(self, number: int) -> bool:
        ranges = self._ranges
        for position, (low, high) in enumerate(ranges):
            if low <= number <= high:
                return False
            if number > high:
                joins_upper = position > 0 and ranges[position - 1][0] == number + 1
                joins_lower = high + 1 == number
                if joins_upper and joins_lower:
                    ranges[position - 1][0] = low
                    del ranges[position]
                elif joins_upper:
                    ranges[position - 1][0] = number
                elif joins_lower:
                    ranges[position][1] = number
                else:
                    ranges.insert(position, [number, number])
                    if len(ranges) > MAX_ACK_RANGES:
                        self._floor = ranges.pop()[1]
                return True
        if ranges[-1][0] == number + 1:
            ranges[-1][0] = number
        elif len(ranges) < MAX_ACK_RANGES:
            ranges.append([number, number])
        else:
            return False
        return True

    def owe_ack(self, now: float, count: int = 1) -> None:
        """Owe an acknowledgement of ack-eliciting datagrams: now after a gap or ACK_EVERY of them, else soon."""
        self._unacked += count
        if self._unacked >= ACK_EVERY or self._gap:
            self.ack_at = now
        elif self.ack_at is None:
            self.ack_at = now + MAX_ACK_DELAY_S

    def take_ack(self, now: float) -> tuple[list[tuple[int, int]], float]:
        """Return the ranges and the delay since the largest came, and clear what is owed."""
        self.ack_at = None
        self._unacked = 0
        self._gap = False
        return [(low, high) for low, high in self._ranges], max(0.0, now - self._largest_at)
