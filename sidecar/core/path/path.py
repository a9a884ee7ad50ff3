"""One path: where it leads, and whether it lives."""

from __future__ import annotations

from typing import TYPE_CHECKING

from sidecar.core.base.timers import NEVER
from sidecar.core.base.values import PathId, PathState
from sidecar.core.path.address import PathAddress
from sidecar.core.path.congestion.controller import CongestionController
from sidecar.core.path.congestion.rtt import RttEstimator
from sidecar.core.path.pmtu import PathMtu
from sidecar.core.path.probing import Probing
from sidecar.core.path.recovery import Recovery
from sidecar.core.path.send_queue import SendQueue
from sidecar.core.seam.links import PathMeasured
from sidecar.core.wire.frame import Finished, encode_ack, encode_finished

if TYPE_CHECKING:
    import random
    from collections.abc import Collection

    from protos.base.token_bucket import TokenBucket
    from protos.model.ids import Address, InterfaceId, NodeName, SessionId
    from sidecar.core.path.keys import PathKeys
    from sidecar.core.path.probing import SentPing
    from sidecar.core.wire.frame import KeyAnswer, KeyOffer

DOWN_FACTOR = 4.0
"""An unstable path is down after this many times the silence that made it unstable, or the longest that anybody waits
beyond that, ..."""
DOWN_FLOOR_S = 0.5
"""... but not before this."""
DOWN_WAIT_S = 2.0
"""One whose answers take long is down so much after its next answer is overdue, or after the time that it takes."""
INTRODUCER_S = 5.0
"""Where a peer introduced itself from twice may be where it is to be found, for so long."""
MAX_RTT_SAMPLES = 512
"""Round-trip times kept between two reports."""


class Path:
    """Sender's and receiver's state of one path. Owned by its link."""

    __slots__ = (
        "_exchanges",
        "_introduced_at",
        "_introducer",
        "_oldest_at",
        "_rebound",
        "_rng",
        "_waiting_since",
        "address",
        "bytes_sent",
        "candidates",
        "control",
        "finished",
        "id",
        "introductions",
        "keys",
        "mtu",
        "opening",
        "pending",
        "pending_by",
        "pings",
        "probing",
        "queue",
        "received",
        "recovery",
        "remote_id",
        "renewed_at",
        "reported_fates",
        "reported_lost",
        "reported_sent",
        "rtts",
        "sealing",
        "session",
        "source",
        "state",
        "unproven",
    )

    def __init__(
        self,
        path_id: PathId,
        session: SessionId,
        keys: PathKeys,
        candidates: tuple[Address, ...],
        first_number: int,
        now: float,
        rng: random.Random,
        unproven: TokenBucket,
        exchanges: TokenBucket,
        *,
        leads: bool,
    ) -> None:
        """`leads`: this end is the one that keeps the path alive (see `Probing`).

        `unproven` holds what may go to where the peer has never proven to be, in bytes; all its paths share it.
        `exchanges` holds how many exchanges of keys are worked on; they share it too.
        """
        self.id = path_id
        self.remote_id: InterfaceId = path_id.remote
        self.session = session
        self._rng = rng
        self._exchanges = exchanges
        self.keys = keys
        self.sealing = keys.sealing
        self.opening = keys.opening
        self.received = keys.received
        self.candidates = candidates
        self.address = PathAddress()
        self.unproven = unproven
        self.source: str | None = None
        """Which of our addresses the kernel sends from to there, as far as the driver knows."""
        self.state = PathState.DOWN
        self.recovery = Recovery(first_number, rng)
        self.control = CongestionController()
        self.mtu = PathMtu()
        self.queue = SendQueue()
        self.introductions: list[tuple[Address, int, KeyAnswer | None]] = []
        """Where the peer introduced itself from, the probe that it wants answered there, and what answers its offer."""
        self.pending: list[bytes] = []
        """Encoded control frames that wait for the next datagram ..."""
        self.finished: dict[int, None] = {}
        """... and messages to be reported FINISHED in it ..."""
        self.pending_by = NEVER
        """... which leaves at this moment (s) at the latest; NEVER when none waits."""
        self.pings: list[SentPing] = []
        """Pings that wait to leave."""
        self.probing = Probing(now, rng, leads=leads)
        self.rtts: list[float] = []
        self.bytes_sent = 0
        self.reported_sent = 0
        self.reported_lost = 0
        self.reported_fates = (0, 0)
        self._introduced_at = -NEVER
        self._introducer: Address | None = None
        self.renewed_at: float | None = None
        """When our credential was signed anew, until the peer answers an introduction with it."""
        self._waiting_since: float | None = None
        self._oldest_at = now
        """When the oldest of what waits for an answer left."""
        self._rebound = False

    @property
    def peer(self) -> NodeName:
        """The node at the other end."""
        return self.id.peer

    @property
    def remote(self) -> Address | None:
        """Where it leads: to where the newest authentic datagram came from."""
        return self.address.address

    @property
    def family(self) -> int | None:
        """4 or 6: of the address that it leads to; None while none is known."""
        return None if self.remote is None else 6 if ":" in self.remote[0] else 4

    def leaves_from(self, addresses: Collection[str]) -> bool:
        """Whether it leaves from one of these, by their family alone if its own address is not known."""
        if self.source is not None:
            return self.source in addresses
        return self.family in {6 if ":" in address else 4 for address in addresses}

    @property
    def probe_at(self) -> float:
        """When the next probe leaves (s); NEVER while nothing may."""
        if self.state is PathState.DOWN:
            return self.probing.at
        if self.goes_to_one and self.address.is_blocked:
            return NEVER
        return min(self.probing.at, self.keys.offers_at)

    @property
    def mtu_probe_at(self) -> float | None:
        """When the next probe of the path's MTU leaves (s): not to where the peer has not proven to be."""
        return self.mtu.timer if self.address.is_proven else None

    @property
    def gives_up_address_at(self) -> float | None:
        """When it leads to where it led before, unless the peer proves to be where it leads now (s)."""
        if self.state is PathState.DOWN:
            return None
        return self.address.gives_up_at(self.recovery.rtt.next_answer())

    @property
    def goes_to_one(self) -> bool:
        """Whether probes go to the known address, not to all that may be it: the path is down, or just rebound."""
        return self.remote is not None and self.state is not PathState.DOWN and not self._rebound

    def destinations(self, now: float, size: int) -> list[Address]:
        """Where probes of `size` bytes go now that look for the peer."""
        introducer = self._introducer if now < self._introduced_at + INTRODUCER_S else None
        others = dict.fromkeys((self.remote, introducer))
        all_of_them = (*(one for one in others if one and one not in self.candidates), *self.candidates)
        return [one for one in all_of_them if self._may_look_at(one, now, size)]

    def _may_look_at(self, address: Address, now: float, size: int) -> bool:
        if self.address.proven(address):
            return True
        if address == self.remote and address not in self.candidates:
            return (self.address.allowance or 0) >= size
        return self.unproven.take(now, size)

    def keeps_address(self, source: Address) -> bool:
        """Whether an authentic datagram from another of the peer's known addresses is no reason to go there as well.

        It is none while the present one, known as well, answers. An unknown one means that a NAT forgot the peer, or
        that somebody else passes on what it sends: to be left as soon as a datagram comes from a known one.
        """
        known = source in self.candidates and self.remote in self.candidates
        return known and self.state is PathState.UP and not self._rebound

    def note_introduction(self, source: Address, probe_id: int, answer: KeyAnswer | None, now: float) -> None:
        """The peer introduced itself from here, and wants a probe answered, and perhaps an offer of keys.

        When it does so again although it was answered, it can not read the answer: it does not know yet that we were
        restarted. Behind a NAT it may be reachable there only, so that our own introduction has to go there too.
        """
        self.introductions.append((source, probe_id, answer))
        if self.state is PathState.DOWN:
            again = now < self._introduced_at + INTRODUCER_S
            self._introducer, self._introduced_at = source if again else None, now

    def ask(self, now: float, to: Address) -> int:
        """Return the id of a probe that leaves now to this address and to no other, by plan."""
        self.waits_for_answer(now)
        return self.probing.ask(now, to, sealed=self.state is not PathState.DOWN)

    def offer_keys(self, now: float) -> KeyOffer | None:
        """Return what to offer with what leaves now, if new keys are due and we lead."""
        return self.keys.offer(now, self._rng)

    def answer_keys(self, offer: KeyOffer, now: float) -> KeyAnswer | None:
        """Return the answer to an offer, if there is one; raises DecodeError."""
        return self.keys.answer(offer, now, self._rng, self._exchanges)

    def take_keys(self, answer: KeyAnswer, now: float) -> bool:
        """Go on with the keys that an answer completes; False if nothing is asked. Raises DecodeError."""
        return self.keys.take(answer, now, self._exchanges)

    def plan_probe(self, now: float) -> None:
        """A probe left: plan the next one."""
        if self.state is PathState.DOWN:
            self.probing.plan_down(now)
        elif self.state is PathState.UNSTABLE or not self.address.is_proven:
            self.probing.plan_unstable(now, self.recovery.rtt.smoothed)
        else:
            self.probing.plan_up(now)

    def asked(self, now: float) -> None:
        """The peer probed the path."""
        if self.state is PathState.UP:
            self.probing.asked(now)

    def needed(self, now: float) -> None:
        """Requests go to the peer: it must be known soon whether this path can carry them."""
        if self.state is PathState.UP:
            self.probing.needed(now)

    def hasten_probe(self, now: float) -> None:
        """It is time to ask again, as far as `Probing.hasten` lets."""
        self.probing.hasten(now, self.recovery.rtt.smoothed)

    def start_afresh(self, now: float) -> None:
        """The way to the peer changed: nothing measured on the old one holds (RFC 9000 section 9.4)."""
        self.recovery.rtt = RttEstimator()
        self.control = CongestionController()
        self.probing.forget()
        self._rebound = True
        self.probing.begin_again(now)
        if self.state is PathState.UP:
            self.state = PathState.UNSTABLE
            self._waiting_since = self._oldest_at = now

    def answered_probe(self, probe_id: int, now: float) -> float | None:
        """A PROBE_REPLY came: return when what it answers left (s), None when it answers nothing we asked."""
        probe = self.probing.answered(probe_id, now)
        if probe is None:
            return None
        if probe.to is not None:
            self.address.prove(probe.to)
        self.recovery.rtt.sample(now - probe.sent_at, now)
        if not probe.sealed and self.renewed_at is not None and probe.sent_at >= self.renewed_at:
            self.renewed_at = None
        self.note_rtt()
        return probe.sent_at

    @property
    def control_at(self) -> float:
        """When control frames leave without company (s); NEVER when none wait, or none may leave."""
        if self.address.is_blocked:
            return NEVER
        ack_at = self.received.ack_at
        return self.pending_by if ack_at is None else min(ack_at, self.pending_by)

    def take_control(self, now: float) -> list[bytes]:
        """Remove and return the control frames that wait, the acknowledgement that is owed included."""
        taken, self.pending = self.pending, []
        taken += [encode_finished(Finished(number)) for number in self.take_pending_finished()]
        if self.received.ack_at is not None:
            taken.append(encode_ack(*self.received.take_ack(now)))
        self.pending_by = NEVER
        return taken

    def take_pending_finished(self) -> tuple[int, ...]:
        """Return which messages are to be reported FINISHED, and forget it."""
        finished = tuple(self.finished)
        self.finished.clear()
        return finished

    def note_rtt(self) -> None:
        """Keep the latest round-trip time for the next report."""
        if len(self.rtts) < MAX_RTT_SAMPLES:
            self.rtts.append(self.recovery.rtt.latest)

    def take_measured(self) -> PathMeasured | None:
        """Return what was measured since the last call; None when nothing was."""
        recovery = self.recovery
        sent, lost = recovery.total_sent, recovery.total_lost
        if not self.rtts and sent == self.reported_sent:
            return None
        measured = PathMeasured(
            self.id,
            recovery.rtt.smoothed,
            tuple(self.rtts),
            sent - self.reported_sent,
            lost - self.reported_lost,
            *self._take_fates(),
            policed=self.control.policer.was_found,
        )
        self.control.policer.was_found = False
        self.rtts.clear()
        self.reported_sent, self.reported_lost = sent, lost
        return measured

    def _take_fates(self) -> tuple[int, int]:
        """Return how many datagrams arrived and were missed since the last call."""
        arrived, missed = self.recovery.total_arrived, self.recovery.reordering.missed
        told_arrived, told_missed = self.reported_fates
        # More may have turned up late than was missed in the meantime: then so many fewer are told next time.
        self.reported_fates = arrived, max(missed, told_missed)
        return arrived - told_arrived, max(0, missed - told_missed)

    def waits_for_answer(self, now: float) -> None:
        """Something that wants an answer left."""
        if self._waiting_since is None:
            self._waiting_since = self._oldest_at = now

    def made_progress(self, now: float) -> bool:
        """The peer proved that our datagrams arrive; True when that brings the path up.

        Not before there are fresh keys: who has but one end's session key could have seemed the other.
        """
        if not self.keys.are_fresh:
            return False
        sent = self.recovery.sent
        self._waiting_since = None
        if sent:
            self._waiting_since, self._oldest_at = now, sent[0].at
        self._rebound = False
        if self.state is PathState.UP:
            self.probing.proven(now)
            return False
        self.state = PathState.UP
        self._introduced_at, self._introducer = -NEVER, None
        self.probing.came_up(now)
        return True

    @property
    def silence_timer(self) -> float | None:
        """When the present silence makes the path unstable or down.

        Two things must be overdue: any sign of life, by how the path answered until now, and the answer to the oldest
        of what left, by how long the last one took. Of a path that is in use the first one says more: whatever queue
        there is, what stands in it arrives one after the other. Of one that rested nothing is to be expected before a
        round trip is over, and with a queue of others that may be one of many seconds.
        """
        if self._waiting_since is None or self.state is PathState.DOWN:
            return None
        rtt = self.recovery.rtt
        limit, answer = rtt.silence_limit(), rtt.next_answer()
        if self.state is not PathState.UP:
            limit = max(min(DOWN_FACTOR * limit, limit + rtt.longest_wait()), DOWN_FLOOR_S)
            answer += min(rtt.latest, DOWN_WAIT_S)
        return max(self._waiting_since + limit, self._oldest_at + answer)

    def check_silence(self, now: float) -> PathState | None:
        """Return the new state when the silence changed it."""
        timer = self.silence_timer
        if timer is None or timer > now:
            return None
        if self.state is PathState.UP:
            self.state = PathState.UNSTABLE
        else:
            self.go_down()
        self.probing.at = now
        return self.state

    def go_down(self) -> None:
        """It is as good as dead. What was asked before may still be answered, if the path is slow rather than dead."""
        self.state = PathState.DOWN
        self._waiting_since = None
        self.opening.forget_previous()
        self.mtu.stop()
