"""Simulates one control stream: it delays, stalls, breaks, and dies silently."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING

from plr.controlplane.core.publish.messages import CloseReason
from plr.controlplane.core.registry.registry import Refusal
from plr.controlplane.serve.mailbox import Mailbox
from plr.protos.convert import (
    control_message_to_proto,
    parse_control_message,
    parse_sidecar_message,
    sidecar_message_to_proto,
)
from plr.protos.model.members import PeerSet, Registration
from plr.protos.model.stream import Heartbeat

if TYPE_CHECKING:
    import random

    from bench.fleetday.member import Member
    from bench.fleetday.plane import Plane
    from bench.fleetday.timeline import Timeline
    from plr.controlplane.core.registry.registry import StreamId
    from plr.protos.model.stream import ControlMessage, SidecarMessage

IN_FLIGHT = 2
"""Messages that a connection's buffers hold; the others wait in the mailbox, where newer ones replace older ones."""

CONVERTED_ONE_IN = 20
"""One in this many messages goes through protobuf; the others are handed over as they are."""

FEW_PEERS, LARGE_CONVERTED_ONE_IN = 50, 400
"""The same for sets of more than a few peers, which take some milliseconds."""

_NOT_ANSWERED_SOON = frozenset({CloseReason.REPLACED, CloseReason.REVOKED, CloseReason.CERTIFICATE_ENDED})
"""Reasons to close whose gRPC status is among the sidecar's REFUSALS."""


class Line:
    """A stream between one sidecar and the control plane; each end has its own belief of whether it is open."""

    def __init__(self, timeline: Timeline, plane: Plane, member: Member, rng: random.Random) -> None:
        self._timeline = timeline
        self._plane = plane
        self._member = member
        self._rng = rng
        self._delay_s = rng.uniform(0.005, 0.08)
        self._mailbox = Mailbox()
        self._in_flight = 0
        self._read_at = 0.0
        """When the sidecar reads the message written last."""
        self._stream: StreamId | None = None
        self.dead = False
        """Whether nothing arrives at either end any more."""
        self.slow_s = 0.0
        """Time that the sidecar takes to read a message, in seconds on top of the delay."""
        self.stalled_until = 0.0
        """Time before which the sidecar reads nothing."""

    # ── the sidecar's end ──

    def say(self, message: SidecarMessage) -> None:
        """Write a message of the sidecar."""
        if self.dead:
            return
        if isinstance(message, Heartbeat):
            # The delay matters for one in a thousand of these, and they are most of a fleet's messages.
            if self._stream is not None and self._plane.up:
                self._plane.beat(self._stream, message)
            return
        if self._rng.randrange(CONVERTED_ONE_IN) == 0:
            message = parse_sidecar_message(sidecar_message_to_proto(message).SerializeToString())
        self._timeline.after(self._delay_s, partial(self._heard, message))

    def hang_up(self) -> None:
        """End the stream at the sidecar; the control plane learns of it if anything arrives there."""
        if not self.dead:
            self._timeline.after(self._delay_s, self._lost)
        self.dead = True

    def cut(self) -> None:
        """Reset the connection: both ends learn of it now."""
        self.dead = True
        self._lost()
        self._member.line_ended(self, refused=False)

    # ── the control plane's end ──

    def _heard(self, message: SidecarMessage) -> None:
        if self.dead or not self._plane.up:
            return
        if isinstance(message, Registration):
            result = self._plane.register(message, self)
            if isinstance(result, Refusal):
                self._end(refused=True)
            else:
                self._stream = result
                self._write()
        elif self._stream is not None:
            self._plane.receive(self._stream, message)

    def put(self, message: ControlMessage) -> None:
        """Write a message of the control plane."""
        self._mailbox.put(message)
        self._write()

    def close(self, reason: CloseReason) -> None:
        """End the stream at the control plane."""
        self._mailbox.close(reason)
        self._write()

    def _write(self) -> None:
        while self._stream is not None and self._in_flight < IN_FLIGHT and not self.dead:
            message = self._mailbox.take()
            if message is None:
                return
            if isinstance(message, CloseReason):
                self._lost()
                self._end(refused=message in _NOT_ANSWERED_SOON)
                return
            many = isinstance(message, PeerSet) and len(message.peers) > FEW_PEERS
            if self._rng.randrange(LARGE_CONVERTED_ONE_IN if many else CONVERTED_ONE_IN) == 0:
                message = parse_control_message(control_message_to_proto(message).SerializeToString())
            self._in_flight += 1
            arrives = self._timeline.now + self._delay_s
            self._read_at = max(arrives, self._read_at, self.stalled_until) + self.slow_s
            self._timeline.at(self._read_at, partial(self._arrive, message))

    def _arrive(self, message: ControlMessage) -> None:
        self._in_flight -= 1
        if self.dead:
            return
        self._member.hear(self, message)
        self._write()

    def _end(self, *, refused: bool) -> None:
        self._member.fell_ill()  # it believes that the stream is open until it hears of the end
        self._timeline.after(self._delay_s, partial(self._member.line_ended, self, refused=refused))
        self.dead = True

    def _lost(self) -> None:
        """End the control plane's side of the stream."""
        if self._stream is not None:
            self._plane.disconnected(self._stream)
            self._stream = None

    @property
    def superseded(self) -> int:
        """Messages replaced by a newer one before they were written."""
        return self._mailbox.superseded
