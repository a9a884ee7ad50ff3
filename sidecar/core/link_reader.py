"""Datagrams as they come: whose they are, what they hold. Nothing that is wrong gets further than a counter."""

from __future__ import annotations

from typing import TYPE_CHECKING

from protos.errors import DecodeError
from sidecar.core import frame
from sidecar.core.frame import (
    FRAGMENT_DATAGRAM,
    FRAGMENT_DATAGRAM_BYTES,
    FRAGMENT_TYPE,
    HEADER_BYTES,
    MAX_MESSAGE_BYTES,
    MAX_SYMBOL_BYTES,
    MIN_SYMBOL_BYTES,
    REPAIR_TYPE,
    Fragment,
    Header,
    is_repair_index,
)
from sidecar.core.link_events import (
    FragmentsReceived,
    MessageAbandoned,
    MessageFinished,
    MessageForgotten,
    PeerClosed,
    PeerRestarted,
)
from sidecar.core.path_id import PathState

if TYPE_CHECKING:
    from protos.model import Address
    from sidecar.core.link_mtu import LinkMtu
    from sidecar.core.path_keeper import PathKeeper
    from sidecar.core.path_table import PathTable
    from sidecar.core.paths import Path


class LinkReader:
    """Reads what one link receives."""

    __slots__ = ("_events", "_keeper", "_mtu", "_stats", "_table")

    def __init__(self, table: PathTable, keeper: PathKeeper, mtu: LinkMtu) -> None:
        self._table = table
        self._keeper = keeper
        self._mtu = mtu
        self._events = table.events
        self._stats = table.stats

    def receive_batch(self, data: memoryview, segment: int, source: Address, now: float) -> None:
        """See `Link.receive_batch`."""
        self._stats.bytes["received"] += len(data)
        end = len(data)
        position = self._receive_fragments(data, 0, segment, source, now)
        while position < end or not end:
            self._receive_datagram(data[position : position + segment], source, now)
            position += segment
            if position >= end:
                break
            position = self._receive_fragments(data, position, segment, source, now)

    def _receive_fragments(self, data: memoryview, position: int, segment: int, source: Address, now: float) -> int:
        """Take the datagrams from `position` on that hold one FRAGMENT or REPAIR and nothing else, as long as they are
        of one path and come in order; returns the position of the first that is not. Nearly all datagrams of a long
        message are such. What looks odd is left to `_receive_datagram`.
        """
        end = len(data)
        if end - position < FRAGMENT_DATAGRAM_BYTES:
            return position
        unpack, new = FRAGMENT_DATAGRAM.unpack_from, tuple.__new__
        head, session, first, kind, *_ = unpack(data, position)
        if kind != FRAGMENT_TYPE and kind != REPAIR_TYPE:
            return position
        path = self._table.of_head(head, session)
        if path is None or first <= path.received.largest:
            return position
        received = path.received
        low = first
        high = first - 1
        fragments: list[Fragment] = []
        while end - position >= FRAGMENT_DATAGRAM_BYTES:
            its_head, its_session, number, kind, message, total, symbol, index = unpack(data, position)
            stop = position + segment
            if stop > end:
                stop = end
            if kind == FRAGMENT_TYPE:
                length = total - index * symbol
                if length > symbol:
                    length = symbol
            elif kind == REPAIR_TYPE and symbol and is_repair_index(index, total, symbol):
                length = symbol
            else:
                break
            if (
                number <= high
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
            self._heard(path, source, now, newest=True)
            self._stats.datagrams["received", "data"] += len(fragments)
            self._hand_up(path, fragments)
            received.owe_ack(now, len(fragments))
        return position

    def _heard(self, path: Path, source: Address, now: float, *, newest: bool) -> None:
        """A datagram that is neither forged nor a duplicate came; `newest`: sent after all that came before."""
        if newest and source != path.remote:
            self._mtu.moved(path, source, now)
        if path.state is PathState.DOWN:
            path.hasten_probe(now)
        self._table.dirty[path.id] = path

    def _hand_up(self, path: Path, fragments: list[Fragment]) -> None:
        """Append to the event before, if it is of the same path and session."""
        before = self._events[-1] if self._events else None
        if isinstance(before, FragmentsReceived) and before.path is path.id and before.session == path.session:
            before.fragments.extend(fragments)
        else:
            self._events.append(FragmentsReceived(path.id, path.session, fragments))

    def _receive_datagram(self, data: memoryview, source: Address, now: float) -> None:
        stats = self._stats
        try:
            header = frame.decode_header(data)
            peer = self._table.by_session.get(header.session)
            if peer is None:
                self._receive_from_stranger(header, data[HEADER_BYTES:])
                return
            if header.receiver_interface != self._table.identity.interface_id:
                stats.dropped["wrong_interface"] += 1
                return
            path = self._table.paths.get((peer.name, header.sender_interface))
            frames = frame.decode_frames(data[HEADER_BYTES:])
            if path is None:
                path = self._table.introduce(peer, header, frames[0], now)
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

    def _receive_from_stranger(self, header: Header, body: memoryview) -> None:
        """An unknown session: only a HELLO of a known peer's newer start is listened to."""
        frames = frame.decode_frames(body)
        hello = frames[0]
        if isinstance(hello, frame.Hello):
            peer = self._table.by_token.get(hello.token)
            if peer is not None and hello.incarnation > peer.incarnation:
                self._events.append(PeerRestarted(peer.name, header.session, hello.incarnation))
                return
        self._stats.dropped["unknown_session"] += 1

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
                    self._keeper.on_ack(path, item, now)
                case frame.Probe(probe_id) if self._table.closing:
                    pass  # an answer would bring us back to life over there
                case frame.Probe(probe_id):
                    self._table.owe(path, frame.encode_probe_reply(frame.ProbeReply(probe_id)))
                case frame.ProbeReply(probe_id) if self._mtu.answered(path, probe_id, now):
                    pass
                case frame.ProbeReply(probe_id):
                    if not path.answered_probe(probe_id, now):
                        self._stats.dropped["unasked_probe_reply"] += 1
                    else:
                        path.mtu.on_delivered(0)
                        if path.made_progress(now):
                            self._keeper.path_up(path, now)
                case frame.Finished(number):
                    eliciting = True
                    events.append(MessageFinished(path.peer, number))
                case frame.Abandon(number):
                    events.append(MessageAbandoned(path.peer, path.session, number))
                case frame.Forgotten(number):
                    events.append(MessageForgotten(path.peer, number))
                case frame.Close() if path.state is not PathState.DOWN:
                    self._keeper.take_down(path, "peer closed")
                    events.append(PeerClosed(path.peer))
                case frame.Close():
                    pass
                case frame.Hello():
                    pass
        self._stats.datagrams["received", kind] += 1
        if eliciting:
            path.received.owe_ack(now)
