"""Combines the state of one path: where it leads, and whether it lives."""

from __future__ import annotations

from typing import TYPE_CHECKING

from plr.sidecar.core.base.timers import NEVER
from plr.sidecar.core.base.values import PathId, PathState
from plr.sidecar.core.path.address import PathAddress
from plr.sidecar.core.path.introductions import Introductions
from plr.sidecar.core.path.owed import Owed
from plr.sidecar.core.path.pmtu import PathMtu
from plr.sidecar.core.path.probing import Probing
from plr.sidecar.core.path.recent_loss import RecentLoss
from plr.sidecar.core.path.recovery import Recovery
from plr.sidecar.core.path.report import PathReport
from plr.sidecar.core.path.send_queue import SendQueue
from plr.sidecar.core.wire.frame import encode_ack

if TYPE_CHECKING:
    import random
    from collections.abc import Callable, Collection

    from plr.protos.base.token_bucket import TokenBucket
    from plr.protos.model.ids import Address, InterfaceId, NodeName, SessionId
    from plr.sidecar.core.path.congestion.controller import CongestionController
    from plr.sidecar.core.path.keys import PathKeys
    from plr.sidecar.core.path.probing import SentPing
    from plr.sidecar.core.seam.links import PathMeasured
    from plr.sidecar.core.wire.frame import KeyAnswer, KeyOffer

DOWN_FACTOR = 4.0
"""An unstable path is down after this many times the silence that made it unstable, or after the longest wait on top of
that silence if that is sooner, ..."""
DOWN_FLOOR_S = 0.5
"""... but not before this."""
DOWN_WAIT_S = 2.0
"""A path with slow answers is down this long after its next answer is overdue, or one answer time after if sooner."""


class Path:
    """Sender's and receiver's state of one path. Its link owns it."""

    __slots__ = (
        "_exchanges",
        "_make_control",
        "_oldest_at",
        "_rebound",
        "_report",
        "_rng",
        "_unproven",
        "_waiting_since",
        "address",
        "bytes_sent",
        "candidates",
        "control",
        "id",
        "introductions",
        "keys",
        "mtu",
        "opening",
        "owed",
        "pings",
        "probing",
        "queue",
        "received",
        "recent_loss",
        "recovery",
        "remote_id",
        "renewed_at",
        "sealing",
        "session",
        "source",
        "state",
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
        make_control: Callable[[], CongestionController],
        *,
        leads: bool,
    ) -> None:
        """Create the path; `leads`: this end keeps it alive (see `Probing`).

        `unproven` limits the bytes that go to addresses that the peer has never proven. All paths to that peer share
        it. `exchanges` limits how many key exchanges are processed; they share it too. `make_control` makes the
        congestion controller, and another one when the route changes.
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
        self._unproven = unproven
        self.source: str | None = None
        """The local address from which the kernel sends there, as far as the driver knows."""
        self.state = PathState.DOWN
        self.recovery = Recovery(first_number, rng)
        self._make_control = make_control
        self.control = make_control()
        self.mtu = PathMtu()
        self.queue = SendQueue()
        self.introductions = Introductions()
        self.owed = Owed()
        self.pings: list[SentPing] = []
        """Pings that wait to leave."""
        self.probing = Probing(now, rng, leads=leads)
        self._report = PathReport()
        self.recent_loss = RecentLoss(now)
        self.bytes_sent = 0
        self.renewed_at: float | None = None
        """When our credential was renewed, until the peer answers an introduction with it."""
        self._waiting_since: float | None = None
        self._oldest_at = now
        """When the oldest datagram that still waits for an answer left."""
        self._rebound = False

    @property
    def peer(self) -> NodeName:
        """The node at the other end."""
        return self.id.peer

    @property
    def remote(self) -> Address | None:
        """The source of the newest authentic datagram."""
        return self.address.address

    @property
    def family(self) -> int | None:
        """4 or 6, from the remote address; None while that is unknown."""
        return None if self.remote is None else 6 if ":" in self.remote[0] else 4

    def leaves_from(self, addresses: Collection[str]) -> bool:
        """Return whether it leaves from one of these; while its own address is unknown, their families decide."""
        if self.source is not None:
            return self.source in addresses
        return self.family in {6 if ":" in address else 4 for address in addresses}

    def announced(self, candidates: tuple[Address, ...], crowd: int) -> None:
        """Take the addresses at which the peer may be; it announced `crowd` of them over all its interfaces."""
        self.candidates = candidates
        self.probing.crowd = crowd

    def set_dormant(self, now: float, *, dormant: bool) -> None:
        """Note whether the peer is dormant. When that ends, the path is asked at once: the peer is likely back."""
        if self.probing.dormant and not dormant and self.state is PathState.DOWN:
            self.probing.begin_again(now)
        self.probing.dormant = dormant

    @property
    def is_dormant(self) -> bool:
        """Whether the peer is dormant. Once the path is up, it is not, although the link is told so a little later."""
        return self.probing.dormant and self.state is PathState.DOWN

    def note_source(self, source: str | None) -> None:
        """Note the local address from which the kernel sends there; None while it is unknown."""
        self.source = source

    def move(self, source: Address, now: float) -> bool:
        """Lead to where the peer's datagrams come from now.

        Return whether that is by another route, rather than only by another port that a NAT gave the peer.
        """
        elsewhere = self.remote is not None and source[0] != self.remote[0]
        self.address.move(source, now)
        if elsewhere:
            self.source = None
        return elsewhere

    def sent(self, address: Address, size: int) -> None:
        """Count `size` bytes that went to `address`."""
        self.bytes_sent += size
        self.address.went(address, size)

    @property
    def probe_at(self) -> float:
        """When the next probe leaves (s); NEVER while nothing may leave."""
        if self.state is PathState.DOWN:
            return self.probing.at
        if self.goes_to_one and self.address.is_blocked:
            return NEVER
        return min(self.probing.at, self.keys.offers_at)

    @property
    def mtu_probe_at(self) -> float | None:
        """When the next probe of the path's MTU leaves (s); None while the peer has not proven its address."""
        return self.mtu.timer if self.address.is_proven else None

    @property
    def gives_up_address_at(self) -> float | None:
        """When it returns to its last proven address (s), unless the peer proves the current one."""
        if self.state is PathState.DOWN:
            return None
        return self.address.gives_up_at(self.recovery.rtt.next_answer())

    @property
    def goes_to_one(self) -> bool:
        """Whether probes go to the known address only, not to all that may be the peer's as when down or rebound."""
        return self.remote is not None and self.state is not PathState.DOWN and not self._rebound

    def destinations(self, now: float, size: int) -> list[Address]:
        """Return where probes of `size` bytes that look for the peer go now."""
        others = dict.fromkeys((self.remote, self.introductions.introducer(now)))
        all_of_them = (*(one for one in others if one and one not in self.candidates), *self.candidates)
        return [one for number, one in enumerate(all_of_them) if self._may_look_at(one, number, now, size)]

    def _may_look_at(self, address: Address, number: int, now: float, size: int) -> bool:
        if self.address.proven(address):
            return True
        if address == self.remote and address not in self.candidates:
            return (self.address.allowance or 0) >= size
        return self.probing.has_turn(number) and self._unproven.take(now, size)

    def keeps_address(self, source: Address) -> bool:
        """Return whether to ignore that an authentic datagram came from another known address of the peer.

        That holds while the current address, known as well, answers. An unknown address means that a NAT forgot the
        peer, or that somebody relays what it sends: leave it as soon as a datagram comes from a known one.
        """
        known = source in self.candidates and self.remote in self.candidates
        return known and self.state is PathState.UP and not self._rebound

    def note_introduction(self, source: Address, probe_id: int, answer: KeyAnswer | None, now: float) -> None:
        """Note that the peer introduced itself from here, wants a probe answered, and perhaps an offer of keys."""
        self.introductions.note(source, probe_id, answer)
        if self.state is PathState.DOWN:
            self.introductions.found_down(source, now)

    def ask(self, now: float, to: Address) -> int:
        """Return the id of a scheduled probe that leaves now to this address alone."""
        self.waits_for_answer(now)
        return self.probing.ask(now, to, sealed=self.state is not PathState.DOWN)

    def ping(self, ping: SentPing) -> None:
        """Let a ping leave."""
        self.pings.append(ping)

    def take_pings(self) -> list[SentPing]:
        """Remove and return the pings that wait to leave."""
        taken, self.pings = self.pings, []
        return taken

    def renew(self, now: float) -> None:
        """Introduce ourselves again, with the renewed credential, until the peer answers that."""
        self.renewed_at = now

    def offer_keys(self, now: float) -> KeyOffer | None:
        """Return the offer to send now, if new keys are due and we lead."""
        return self.keys.offer(now, self._rng)

    def answer_keys(self, offer: KeyOffer, now: float) -> KeyAnswer | None:
        """Return the answer to an offer, if there is one; raises DecodeError."""
        return self.keys.answer(offer, now, self._rng, self._exchanges)

    def take_keys(self, answer: KeyAnswer, now: float) -> bool:
        """Switch to the keys that an answer completes; False if it answers no pending offer. Raises DecodeError."""
        return self.keys.take(answer, now, self._exchanges)

    def plan_probe(self, now: float) -> None:
        """Plan the next probe after one left."""
        if self.state is PathState.DOWN:
            self.probing.plan_down(now)
        elif self.state is PathState.UNSTABLE or not self.address.is_proven:
            self.probing.plan_unstable(now, self.recovery.rtt.smoothed)
        else:
            self.probing.plan_up(now)

    def asked(self, now: float) -> None:
        """Note that the peer probed the path."""
        if self.state is PathState.UP:
            self.probing.asked(now)

    def needed(self, now: float) -> None:
        """Note that requests go to the peer: whether this path can carry them must be known soon."""
        if self.state is PathState.UP:
            self.probing.needed(now)

    def hasten_probe(self, now: float) -> None:
        """Bring the next probe forward, as far as `Probing.hasten` allows."""
        self.probing.hasten(now, self.recovery.rtt.smoothed)

    def start_afresh(self, now: float) -> None:
        """Discard what was measured, since the route to the peer changed (RFC 9000 section 9.4)."""
        self.recovery.forget_rtt()
        self.control = self._make_control()
        self.probing.forget()
        self._rebound = True
        self.probing.begin_again(now)
        if self.state is PathState.UP:
            self.state = PathState.UNSTABLE
            self._waiting_since = self._oldest_at = now

    def answered_probe(self, probe_id: int, now: float) -> float | None:
        """Take a PROBE_REPLY; return when the probe left (s), or None if it answers nothing we asked."""
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
    def next_release(self) -> float | None:
        """When more of what waits may leave (s), even if past; None if only an acknowledgement lets it."""
        at = self.control.next_release(self.recovery.in_flight)
        return None if at is None else max(at, self.queue.rests_until)

    @property
    def control_at(self) -> float:
        """When control frames leave on their own (s); NEVER if none wait or none may leave."""
        if self.address.is_blocked:
            return NEVER
        ack_at = self.received.ack_at
        return self.owed.by if ack_at is None else min(ack_at, self.owed.by)

    def take_control(self, now: float) -> list[bytes]:
        """Remove and return the waiting control frames, including the acknowledgement that is owed."""
        taken = self.owed.take()
        if self.received.ack_at is not None:
            taken.append(encode_ack(*self.received.take_ack(now)))
        return taken

    def note_rtt(self) -> None:
        """Keep the latest round-trip time for the next report."""
        self._report.note_rtt(self.recovery.rtt.latest)

    def take_measured(self) -> PathMeasured | None:
        """Return what was measured since the last call; None if nothing was."""
        return self._report.take(self.id, self.recovery, self.control)

    def waits_for_answer(self, now: float) -> None:
        """Note that something left that wants an answer."""
        if self._waiting_since is None:
            self._waiting_since = self._oldest_at = now

    def made_progress(self, now: float) -> bool:
        """Note that the peer proved that our datagrams arrive; return True if that brings the path up.

        The path stays down until there are fresh keys: anyone with one end's session key could have posed as the other.
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
        self.introductions.forget_introducer()
        self.probing.came_up(now)
        return True

    @property
    def silence_timer(self) -> float | None:
        """When the current silence makes the path unstable or down.

        Two things must be overdue: any sign of life, by how the path answered so far, and the answer to the oldest
        datagram, by how long the last answer took. On a path in use the first one says more: whatever the queue, its
        datagrams arrive one after the other. On a path that rested nothing can come before a round trip is over, and
        other traffic's queue can make that many seconds.
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
        """Return the new state if the silence changed it."""
        timer = self.silence_timer
        if timer is None or timer > now:
            return None
        if self.state is PathState.UP:
            self.state = PathState.UNSTABLE
        else:
            self.go_down()
        self.probing.ask_at_once(now)
        return self.state

    def go_down(self) -> None:
        """Mark the path down. It may be slow rather than dead, so what was asked before may still be answered."""
        self.state = PathState.DOWN
        self._waiting_since = None
        self.opening.forget_previous()
        self.mtu.stop()
