"""One interface's share of the data plane: datagrams in and out, all its paths. Owned by one thread; sans-IO.

The driver feeds `receive_batch`, `execute` and `handle_timer`, then drains `next_event` and `batches_to_send`.
"""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING

from protos.errors import DecodeError
from protos.model import InterfaceId, SessionId
from sidecar.core import frame
from sidecar.core.datagrams import Batch, Burst, DatagramBuilder
from sidecar.core.frame import (
    FRAGMENT_DATAGRAM,
    FRAGMENT_DATAGRAM_BYTES,
    FRAGMENT_TYPE,
    HEADER_BYTES,
    MAX_MESSAGE_BYTES,
    MAX_SYMBOL_BYTES,
    MIN_SYMBOL_BYTES,
    Fragment,
    Header,
)
from sidecar.core.link_events import (
    FinishedLost,
    FragmentsLost,
    FragmentsReceived,
    LinkCommand,
    LinkEvent,
    MessageAbandoned,
    MessageFinished,
    MessageForgotten,
    PathChanged,
    PathMeasured,
    PathMtuChanged,
    PeerClosed,
    PeerRestarted,
    Rebind,
    Resend,
    ResetPaths,
    Send,
    SendAbandon,
    SendClose,
    SendFinished,
    SendForgotten,
    SetCarrier,
    SetMtu,
    SetPeers,
    SetReady,
)
from sidecar.core.link_mtu import LinkMtu
from sidecar.core.path_id import PathId, PathState
from sidecar.core.paths import Path
from sidecar.core.stats import LinkStats, PathStats
from sidecar.core.timers import Timers

if TYPE_CHECKING:
    import random
    from collections.abc import Iterable

    from protos.model import Address, NodeName
    from sidecar.core.datagrams import LinkIdentity
    from sidecar.core.link_events import LinkPeer
    from sidecar.core.outbound import OutboundMessage
    from sidecar.core.sent import Sent

MEASURE_EVERY_S = 0.25
"""How often a path's round-trip times go to the engine."""
MAX_PENDING_FRAMES = 256
"""Control frames waiting on one path; a peer that makes us owe more is not honest."""
MAX_PATHS_OF_A_PEER = 32
"""Of those that a peer introduces itself by; further ones wait for the control plane's word."""


class Link:
    """All paths over one interface."""

    def __init__(self, identity: LinkIdentity, rng: random.Random, now: float, first_number: int = 0) -> None:
        """`first_number`: the `next_number` of the link that had this interface before, in the same session."""
        self.identity = identity
        self.stats = LinkStats(identity.interface)
        self._builder = DatagramBuilder(identity, self.stats, rng)
        self._by_session: dict[SessionId, LinkPeer] = {}
        self._by_token: dict[bytes, LinkPeer] = {}
        self._paths: dict[tuple[NodeName, InterfaceId], Path] = {}
        self._ready = False
        self._carrier = True
        self._closing = False
        self._events: deque[LinkEvent] = deque()
        self._mtu = LinkMtu(self._events)
        self._dirty: dict[PathId, Path] = {}
        self._timers: Timers[PathId] = Timers()
        self._measure_at = now + MEASURE_EVERY_S
        self._first_number = first_number

    # -- what the driver calls ------------------------------------------------------------------------------------

    def receive_batch(self, data: memoryview, segment: int, source: Address, now: float) -> None:
        """Take datagrams that came from `source` back to back, of `segment` bytes each; the last may be shorter.

        Fragments in the events view `data`: it must keep until the engine has had all events.
        """
        self.stats.bytes["received"] += len(data)
        end = len(data)
        position = self._receive_fragments(data, 0, segment, source, now)
        while position < end or not end:
            self._receive_datagram(data[position : position + segment], source, now)
            position += segment
            if position >= end:
                break
            position = self._receive_fragments(data, position, segment, source, now)

    def _receive_fragments(self, data: memoryview, position: int, segment: int, source: Address, now: float) -> int:
        """Take the datagrams from `position` on that hold one FRAGMENT and nothing else, as long as they are of one
        path and come in order; returns the position of the first that is not. Nearly all datagrams of a long message
        are such. What looks odd is left to `_receive_datagram`.
        """
        end = len(data)
        if end - position < FRAGMENT_DATAGRAM_BYTES:
            return position
        unpack, new = FRAGMENT_DATAGRAM.unpack_from, tuple.__new__
        head, session, first, *_ = unpack(data, position)
        path = self._path_of_head(head, session)
        if path is None or first <= path.received.largest:
            return position
        received = path.received
        largest = received.largest
        low = first
        high = first - 1
        fragments: list[Fragment] = []
        while end - position >= FRAGMENT_DATAGRAM_BYTES:
            its_head, its_session, number, kind, message, total, symbol, index = unpack(data, position)
            stop = min(position + segment, end)
            length = min(symbol, total - index * symbol)
            if (
                number <= high
                or kind != FRAGMENT_TYPE
                or its_head != head
                or its_session != session
                or position + FRAGMENT_DATAGRAM_BYTES + length != stop
                or not MIN_SYMBOL_BYTES <= symbol <= MAX_SYMBOL_BYTES
                or total > MAX_MESSAGE_BYTES
                or (length <= 0 and (index or total))
            ):
                break
            if number != high + 1 and fragments:
                received.add_run(low, high, now)
                low = number
            high = number
            symbol_data = data[position + FRAGMENT_DATAGRAM_BYTES : stop]
            fragments.append(new(Fragment, (message, total, symbol, index, symbol_data)))
            position = stop
        if fragments:
            received.add_run(low, high, now)
            assert received.largest > largest
            self._heard(path, source, now, newest=True)
            self.stats.datagrams["received", "data"] += len(fragments)
            self._hand_up(path, fragments)
            received.owe_ack(now, len(fragments))
        return position

    def _path_of_head(self, head: int, session: int) -> Path | None:
        """Return the path that a datagram of this clear head (its first four bytes) and session came over."""
        peer = self._by_session.get(SessionId(session))
        if peer is None:
            return None
        sender = InterfaceId(head >> 8 & 0xFF)
        if head != frame.clear_head(sender, self.identity.interface_id):
            return None
        return self._paths.get((peer.name, sender))

    def _heard(self, path: Path, source: Address, now: float, *, newest: bool) -> None:
        """A datagram that is neither forged nor a duplicate came; `newest`: sent after all that came before."""
        if newest and source != path.remote:
            self._mtu.moved(path, source, now)
        if path.state is PathState.DOWN:
            path.hasten_probe(now)
        self._dirty[path.id] = path

    def _hand_up(self, path: Path, fragments: list[Fragment]) -> None:
        """Append to the event before, if it is of the same path and session."""
        before = self._events[-1] if self._events else None
        if isinstance(before, FragmentsReceived) and before.path is path.id and before.session == path.session:
            before.fragments.extend(fragments)
        else:
            self._events.append(FragmentsReceived(path.id, path.session, fragments))

    def _receive_datagram(self, data: memoryview, source: Address, now: float) -> None:
        stats = self.stats
        try:
            header = frame.decode_header(data)
            peer = self._by_session.get(header.session)
            if peer is None:
                self._receive_from_stranger(header, data[HEADER_BYTES:])
                return
            if header.receiver_interface != self.identity.interface_id:
                stats.dropped["wrong_interface"] += 1
                return
            path = self._paths.get((peer.name, header.sender_interface))
            frames = frame.decode_frames(data[HEADER_BYTES:])
            if path is None:
                path = self._introduced(peer, header, frames[0], now)
                if path is None:
                    stats.dropped["unknown_path"] += 1
                    return
        except frame.VersionError:
            stats.dropped["version"] += 1
            return
        except DecodeError:
            stats.dropped["malformed"] += 1
            return
        newest = header.packet_number > path.received.largest
        if not path.received.add(header.packet_number, now):
            stats.dropped["duplicate"] += 1
            return
        self._heard(path, source, now, newest=newest)
        self._receive_frames(path, frames, now)

    def execute(self, command: LinkCommand, now: float) -> None:
        """Carry out what the engine asks."""
        match command:
            case Send(path_id, message):
                path = self._live_path(path_id, message, range(message.symbols))
                if path is not None:
                    path.queue.add(message)
            case Resend(path_id, message, indices):
                path = self._live_path(path_id, message, indices)
                if path is not None:
                    path.queue.resend(message, indices)
            case SendFinished(path_id, number):
                path = self._paths.get((path_id.peer, path_id.remote))
                if path is None or path.state is PathState.DOWN:
                    self._events.append(PathChanged(path_id, PathState.DOWN, "not usable here"))
                    self._events.append(FinishedLost(path_id, (number,)))
                else:
                    self._owe(path, frame.encode_finished(frame.Finished(number)))
            case SendAbandon(path_id, number):
                path = self._paths.get((path_id.peer, path_id.remote))
                if path is not None and path.state is not PathState.DOWN:
                    self._owe(path, frame.encode_abandon(frame.Abandon(number)))
            case SendForgotten(path_id, number):
                path = self._paths.get((path_id.peer, path_id.remote))
                if path is not None:
                    self._owe(path, frame.encode_forgotten(frame.Forgotten(number)))
            case SetPeers(peers):
                self._set_peers(peers, now)
            case SetReady(ready):
                self._ready = ready
                self._probe_what_is_down(now)
            case SetCarrier(on):
                self._carrier = on
                if not on:
                    self._take_all_down("no carrier")
                self._probe_what_is_down(now)
            case ResetPaths(reason):
                self._take_all_down(reason)
                self._probe_what_is_down(now)
            case SetMtu(mtu):
                self._mtu.set_interface(mtu, self._paths.values(), now)
                self._dirty.update((path.id, path) for path in self._paths.values())
            case Rebind():
                for path in self._paths.values():
                    self._rebind(path, now)
            case SendClose():
                self._closing = True
                for path in self._paths.values():
                    if path.state is not PathState.DOWN:
                        self._owe(path, frame.encode_close())

    def handle_timer(self, now: float) -> None:
        """Do what is due by now."""
        self._rearm()
        while (path_id := self._timers.pop_due(now)) is not None:
            path = self._paths[path_id.peer, path_id.remote]
            self._dirty[path_id] = path
            self._path_timer(path, now)
        if now >= self._measure_at:
            self._measure_at = now + MEASURE_EVERY_S
            self._measure(now)

    def next_timer(self) -> float:
        """When `handle_timer` is wanted next."""
        self._rearm()
        timer = self._timers.next()
        return self._measure_at if timer is None else min(timer, self._measure_at)

    def on_too_big(self, destination: Address, size: int, now: float) -> None:
        """The kernel refused to send a datagram of this many bytes over the interface (EMSGSIZE)."""
        for path in self._paths.values():
            if path.remote == destination:
                self._mtu.too_big(path, size, now)
                self._dirty[path.id] = path

    def next_event(self) -> LinkEvent | None:
        """Return the oldest event not taken yet."""
        return self._events.popleft() if self._events else None

    def in_use(self, address: Address) -> bool:
        """Whether a path that is not down leads to this address."""
        return any(path.remote == address and path.state is not PathState.DOWN for path in self._paths.values())

    def batches_to_send(self, now: float) -> list[Batch]:
        """Build what may leave now, at most about BURST_DATAGRAMS; call again until nothing comes."""
        burst = Burst()
        probing = self._may_probe
        for path in list(self._dirty.values()):
            if self._builder.build(path, burst, now, probing=probing):
                del self._dirty[path.id]
                self._arm(path)
            if burst.full:
                break
        return burst.batches

    # -- receiving ------------------------------------------------------------------------------------------------

    def _receive_from_stranger(self, header: Header, body: memoryview) -> None:
        """An unknown session: only a HELLO of a known peer's newer start is listened to."""
        frames = frame.decode_frames(body)
        hello = frames[0]
        if isinstance(hello, frame.Hello):
            peer = self._by_token.get(hello.token)
            if peer is not None and hello.incarnation > peer.incarnation:
                self._events.append(PeerRestarted(peer.name, header.session, hello.incarnation))
                return
        self.stats.dropped["unknown_session"] += 1

    def _introduced(self, peer: LinkPeer, header: Header, first: frame.Frame, now: float) -> Path | None:
        """A known peer speaks from an interface that the control plane has not told of (yet): believed with its token.

        So a robot's new interface works before, and without, the control plane.
        """
        if not isinstance(first, frame.Hello) or first.token != peer.token:
            return None
        if sum(name == peer.name for name, _ in self._paths) >= MAX_PATHS_OF_A_PEER:
            self.stats.dropped["paths_full"] += 1
            return None
        path_id = PathId(self.identity.interface, peer.name, header.sender_interface)
        path = self._paths[peer.name, header.sender_interface] = Path(path_id, peer.session, (), self.next_number, now)
        return path

    def _receive_frames(self, path: Path, frames: list[frame.Frame], now: float) -> None:
        eliciting = False
        events = self._events
        kind = "control"
        for item in frames:
            match item:
                case frame.Fragment():
                    eliciting = True
                    kind = "data"
                    self._hand_up(path, [item])
                case frame.AckFrame():
                    self._receive_ack(path, item, now)
                case frame.Probe(probe_id) if self._closing:
                    pass  # an answer would bring us back to life over there
                case frame.Probe(probe_id):
                    self._owe(path, frame.encode_probe_reply(frame.ProbeReply(probe_id)))
                case frame.ProbeReply(probe_id) if self._mtu.answered(path, probe_id, now):
                    pass
                case frame.ProbeReply(probe_id):
                    if not path.answered_probe(probe_id, now):
                        self.stats.dropped["unasked_probe_reply"] += 1
                    else:
                        path.mtu.on_delivered(0)
                        if path.made_progress(now):
                            self._path_up(path, now)
                case frame.Finished(number):
                    eliciting = True
                    events.append(MessageFinished(path.peer, number))
                case frame.Abandon(number):
                    events.append(MessageAbandoned(path.peer, path.session, number))
                case frame.Forgotten(number):
                    events.append(MessageForgotten(path.peer, number))
                case frame.Close() if path.state is not PathState.DOWN:
                    self._take_down(path, "peer closed")
                    events.append(PeerClosed(path.peer))
                case frame.Close():
                    pass
                case frame.Hello():
                    pass
        self.stats.datagrams["received", kind] += 1
        if eliciting:
            path.received.owe_ack(now)

    def _receive_ack(self, path: Path, ack: frame.AckFrame, now: float) -> None:
        recovery = path.recovery
        newly = recovery.on_ack(ack, now)
        if newly is None:
            self.stats.dropped["acks_the_unsent"] += 1
            return
        _mark_acked(recovery.late(ack, now))
        if not newly:
            return
        _mark_acked(newly)
        path.mtu.on_delivered(max(run.longest for run in newly))
        if recovery.sample is not None:
            path.control.on_acked(recovery.sample, recovery.rtt, now)
        path.note_rtt()
        if path.made_progress(now):
            self._path_up(path, now)
        self._detect_lost(path, now)

    def _path_up(self, path: Path, now: float) -> None:
        path.control.on_path_up(now)
        self._report_measured(path)  # before its first request, so that its round-trip time counts in the choice
        self._events.append(PathChanged(path.id, PathState.UP, "answers"))
        self._mtu.search(path, now)

    @property
    def _may_probe(self) -> bool:
        return self._ready and self._carrier and not self._closing

    def _probe_what_is_down(self, now: float) -> None:
        for path in self._paths.values():
            if path.state is PathState.DOWN:
                path.probe_soon(now)
            self._dirty[path.id] = path

    # -- sending --------------------------------------------------------------------------------------------------

    def _live_path(self, path_id: PathId, message: OutboundMessage, indices: Iterable[int]) -> Path | None:
        """Return the path if it can carry the message; otherwise hand the symbols back as lost.

        The engine may know the path's state from before: it is told again, lest it send them here once more.
        """
        path = self._paths.get((path_id.peer, path_id.remote))
        if path is None or path.state is PathState.DOWN:
            self._events.append(PathChanged(path_id, PathState.DOWN, "not usable here"))
            self._events.append(FragmentsLost(path_id, message, tuple(indices)))
            return None
        if message.datagram_bytes > path.mtu.size:
            self._events.append(PathMtuChanged(path_id, path.mtu.size))
            self._events.append(FragmentsLost(path_id, message, tuple(indices)))
            return None
        self._dirty[path.id] = path
        return path

    def _owe(self, path: Path, encoded: bytes) -> None:
        if len(path.pending) >= MAX_PENDING_FRAMES:
            self.stats.dropped["pending_frames_full"] += 1
            return
        path.pending.append(encoded)
        self._dirty[path.id] = path

    # -- loss and liveness ----------------------------------------------------------------------------------------

    def _path_timer(self, path: Path, now: float) -> None:
        recovery = path.recovery
        if recovery.loss_timer is not None and recovery.loss_timer <= now:
            self._detect_lost(path, now)
        elif recovery.pto_timer is not None and recovery.pto_timer <= now:
            path.control.on_probe_timeout(now)
            self._lost(path, recovery.on_probe_timeout(now), now, timed_out=True)
        state = path.check_silence(now)
        if state is not None:
            if state is PathState.DOWN:
                self._take_down(path, "silent")
            else:
                self._events.append(PathChanged(path.id, state, "silent"))

    def _detect_lost(self, path: Path, now: float) -> None:
        recovery = path.recovery
        lost = recovery.detect_lost(now)
        if lost:
            size = sum(run.size for run in lost)
            path.control.on_lost(size, lost[-1].at, recovery.in_flight, now)
            self._lost(path, lost, now)

    def _take_all_down(self, reason: str) -> None:
        for path in self._paths.values():
            if path.state is not PathState.DOWN:
                self._take_down(path, reason)

    def _take_down(self, path: Path, reason: str) -> None:
        """Hand back what the path still carried, then say that it is down."""
        path.go_down()
        path.control.on_path_down()
        self._events.append(PathChanged(path.id, PathState.DOWN, reason))
        self._report_lost(path, path.recovery.give_up_all())
        unsent = path.take_pending_finished()
        if unsent:
            self._events.append(FinishedLost(path.id, unsent))
        for message, indices in path.queue.clear():
            self._events.append(FragmentsLost(path.id, message, indices))

    def _rebind(self, path: Path, now: float) -> None:
        """What is under way left from where we no longer are, or its answers go there: it travels again elsewhere."""
        was_up = path.state is PathState.UP
        self._mtu.start_afresh(path)
        path.start_afresh(now)
        self._dirty[path.id] = path
        if was_up:
            self._events.append(PathChanged(path.id, path.state, "rebinding"))
        self._report_lost(path, path.recovery.give_up_all(), timed_out=True)

    def _lost(self, path: Path, lost: list[Sent], now: float, *, timed_out: bool = False) -> None:
        self._mtu.lost(path, lost, now)
        self._report_lost(path, lost, timed_out=timed_out)

    def _report_lost(self, path: Path, lost: list[Sent], *, timed_out: bool = False) -> None:
        by_message: dict[int, tuple[OutboundMessage, list[int]]] = {}
        finished: list[int] = []
        for run in lost:
            if run.message is not None:
                missing = filter(run.message.needs, run.indices)
                by_message.setdefault(run.message.number, (run.message, []))[1].extend(missing)
            elif path.state is PathState.DOWN:
                finished += run.finished
            else:
                for number in run.finished:
                    self._owe(path, frame.encode_finished(frame.Finished(number)))
        if finished:
            self._events.append(FinishedLost(path.id, tuple(finished)))
        for message, indices in by_message.values():
            if indices:
                self._events.append(FragmentsLost(path.id, message, tuple(indices), timed_out))

    def _measure(self, now: float) -> None:
        for path in self._paths.values():
            self._report_measured(path)
            path.recovery.reordering.forget_old(path.recovery.rtt, now)
        self._publish_path_stats()

    def _report_measured(self, path: Path) -> None:
        recovery = path.recovery
        sent, lost = recovery.total_sent, recovery.total_lost
        if path.rtts or sent != path.reported_sent:
            self._events.append(
                PathMeasured(
                    path.id,
                    recovery.rtt.smoothed,
                    tuple(path.rtts),
                    sent - path.reported_sent,
                    lost - path.reported_lost,
                    *path.take_fates(),
                )
            )
            path.rtts.clear()
            path.reported_sent, path.reported_lost = sent, lost

    def _publish_path_stats(self) -> None:
        best: dict[NodeName, Path] = {}
        for path in self._paths.values():
            other = best.get(path.peer)
            if other is None or (path.state is PathState.UP and other.state is not PathState.UP):
                best[path.peer] = path
        self.stats.paths = {
            name: PathStats(
                up=path.state is PathState.UP,
                srtt_s=path.recovery.rtt.smoothed,
                datagrams_sent=path.recovery.total_sent,
                datagrams_lost=path.recovery.total_lost,
                spurious_losses=path.recovery.reordering.spurious,
                bytes_sent=path.bytes_sent,
                max_datagram=path.mtu.size,
            )
            for name, path in best.items()
        }

    @property
    def next_number(self) -> int:
        """No path of this link used this packet number or a later one."""
        return max((self._first_number, *(path.recovery.next_number for path in self._paths.values())))

    # -- peers ----------------------------------------------------------------------------------------------------

    def _set_peers(self, peers: tuple[LinkPeer, ...], now: float) -> None:
        before = self._paths
        # A peer that comes back may remember our old packet numbers under the same session: never use one again.
        first_number = self._first_number = self.next_number
        self._by_session = {peer.session: peer for peer in peers}
        self._by_token = {peer.token: peer for peer in peers}
        self._paths = {}
        for peer in peers:
            for remote, addresses in peer.addresses:
                path = before.pop((peer.name, remote), None)
                if path is not None and path.session == peer.session:
                    path.candidates = addresses
                else:
                    if path is not None:
                        before[peer.name, remote] = path
                    path_id = PathId(self.identity.interface, peer.name, remote)
                    path = Path(path_id, peer.session, addresses, first_number, now)
                self._paths[peer.name, remote] = path
                self._dirty[path.id] = path
        for key, path in list(before.items()):
            known = self._by_session.get(path.session)
            if path.state is not PathState.DOWN and known is not None and key not in self._paths:
                # It proves itself, whatever the control plane's view says: older or newer than what happened here.
                self._paths[key] = before.pop(key)
        for path in before.values():
            if path.state is not PathState.DOWN:
                self._take_down(path, "peer left or restarted")
            if (path.peer, path.remote_id) not in self._paths:
                self._dirty.pop(path.id, None)
                self._timers.arm(path.id, None)

    # -- timers ---------------------------------------------------------------------------------------------------

    def _rearm(self) -> None:
        for path in self._dirty.values():
            self._arm(path)

    def _arm(self, path: Path) -> None:
        recovery = path.recovery
        timers = (
            path.probe_at if self._may_probe else None,
            path.mtu.timer if self._may_probe else None,
            path.received.ack_at,
            recovery.loss_timer if recovery.loss_timer is not None else recovery.pto_timer,
            path.silence_timer,
            path.control.next_release(recovery.in_flight) if len(path.queue) else None,
        )
        self._timers.arm(path.id, min((timer for timer in timers if timer is not None), default=None))


def _mark_acked(runs: list[Sent]) -> None:
    for run in runs:
        if run.message is not None:
            run.message.acked[run.symbol : run.symbol + run.datagrams] = b"\1" * run.datagrams
