"""Opens and reads the datagrams that one link receives.

The opener finds out whose a datagram is and whether it is authentic; everything else ends in a counter. The reader acts
on the frames of authentic datagrams, in order of arrival; wrong ones end in a counter too.
"""

from __future__ import annotations

from itertools import islice
from typing import TYPE_CHECKING, TypeVar

from cryptography.exceptions import InvalidTag

from plr.protos.base.errors import DecodeError
from plr.protos.model.ids import InterfaceId, Role, SessionId
from plr.sidecar.core.base.values import PathState
from plr.sidecar.core.crypto.aead import TAG_BYTES
from plr.sidecar.core.path.key_exchange import TooManyExchangesError
from plr.sidecar.core.path.keys import MAX_FAILED
from plr.sidecar.core.seam.links import (
    FragmentsReceived,
    MessageAbandoned,
    MessageFinished,
    MessageForgotten,
    PeerClosed,
    PeerRenewed,
    PeerRestarted,
)
from plr.sidecar.core.wire import frame
from plr.sidecar.core.wire.frame import (
    CLEAR,
    FRAGMENT_HEAD,
    FRAGMENT_HEAD_BYTES,
    FRAGMENT_TYPE,
    HEADER_BYTES,
    INTRODUCTION_FLAG,
    MAX_MESSAGE_BYTES,
    MAX_SYMBOL_BYTES,
    MIN_DATAGRAM_BYTES,
    MIN_SYMBOL_BYTES,
    NONCE_OFFSET,
    REPAIR_TYPE,
    Fragment,
    is_repair_index,
)
from plr.sidecar.core.wire.introduction import UnauthenticError, open_introduction, read_hello_id

if TYPE_CHECKING:
    from collections.abc import Callable

    from plr.protos.model.ids import Address
    from plr.sidecar.core.link.liveness import PathKeeper
    from plr.sidecar.core.link.mtu import LinkMtu
    from plr.sidecar.core.link.path_table import PathTable
    from plr.sidecar.core.path.path import Path
    from plr.sidecar.core.wire.frame import Header

_OVERHEAD_BYTES = HEADER_BYTES + TAG_BYTES

Opened = tuple["Path", int, memoryview]
"""The path that an authentic datagram came over, its packet number, and its frames."""


class LinkOpener:
    """Finds whose a datagram is, and whether it is authentic."""

    __slots__ = ("_dropped", "_table")

    def __init__(self, table: PathTable) -> None:
        self._table = table
        self._dropped = table.stats.dropped

    def open_batch(self, data: memoryview, segment: int, source: Address, now: float) -> list[Opened]:
        """Open contiguous datagrams of `segment` bytes each; the last may be shorter.

        Their frames lie in one new buffer. Introductions are handled here.
        """
        opened: list[Opened] = []
        # Decryption in place would lose a datagram that fails one phase's keys to those of another.
        plain = memoryview(bytearray(len(data)))
        unpack, dropped = CLEAR.unpack_from, self._dropped
        path: Path | None = None
        known: tuple[int, int] | None = None
        end = len(data)
        for start in range(0, end, segment):
            stop = start + segment
            if stop > end:
                stop = end
            if stop - start < MIN_DATAGRAM_BYTES:
                self._refuse(data[start:stop], source, now)
                continue
            head, session, number = unpack(data, start)
            if (head, session) != known:
                known = head, session
                path = self._path_of(head, session)
            if path is None:
                self._refuse(data[start:stop], source, now)
                continue
            body = start + HEADER_BYTES
            out = plain[start : stop - _OVERHEAD_BYTES]
            opening = path.opening
            if opening.failed >= MAX_FAILED:
                dropped["keys_worn_out"] += 1
                continue
            in_use = head == opening.head
            open_into = opening.decrypt_into if in_use else opening.open_other
            try:
                open_into(data[start + NONCE_OFFSET : body], data[body:stop], data[start:body], out)
            except InvalidTag:
                dropped["unauthentic"] += 1
                opening.failed += 1
                continue
            if not in_use and opening.phase == 1:
                self._leave_out(opened, path)
            opened.append((path, number, out))
        return opened

    def _leave_out(self, opened: list[Opened], path: Path) -> None:
        """Drop what was opened before a path's first fresh keys: it must not be read as if sealed with them."""
        fresh = [one for one in opened if one[0] is not path]
        if len(fresh) < len(opened):
            self._dropped["before_fresh_keys"] += len(opened) - len(fresh)
            opened[:] = fresh

    def _path_of(self, head: int, session: int) -> Path | None:
        """Return the path of datagrams with this clear head (the first four bytes) and session."""
        peer = self._table.by_session.get(SessionId(session))
        if peer is None:
            return None
        path = self._table.paths.get((peer.name, InterfaceId(head >> 8 & 0xFF)))
        if path is None or (head ^ path.opening.head) & ~(frame.PHASE_FLAG << 16):
            return None
        return path

    def _refuse(self, datagram: memoryview, source: Address, now: float) -> None:
        """Take an introduction; count anything else, which belongs to no path."""
        try:
            header = frame.decode_header(datagram)
            reason = self._reason(header, datagram, source, now)
        except frame.VersionError:
            reason = "version"
        except frame.UnsealedError:
            reason = "unsealed"
        except UnauthenticError:
            reason = "unauthentic"
        except DecodeError:
            reason = "malformed"
        if reason is not None:
            self._dropped[reason] += 1

    def _reason(self, header: Header, datagram: memoryview, source: Address, now: float) -> str | None:
        if header.flags & INTRODUCTION_FLAG:
            return self._introduction(header, datagram, source, now)
        peer = self._table.by_session.get(header.session)
        if peer is None:
            return "unknown_session"
        if header.receiver_interface != self._table.identity.interface_id:
            return "wrong_interface"
        if (peer.name, header.sender_interface) not in self._table.paths:
            return "unknown_path"
        return "malformed"  # too short for a frame

    def _introduction(self, header: Header, datagram: memoryview, source: Address, now: float) -> str | None:
        """Note what an introduction asks for; return why it is dropped, or None."""
        table = self._table
        peer = table.by_hello.get(read_hello_id(datagram))
        if peer is None:
            return "unknown_introducer"
        if header.receiver_interface != table.identity.interface_id:
            return "wrong_interface"
        probe_id, offer, credential = open_introduction(header, datagram, peer.token, table.identity.name)
        if credential.name != peer.name:
            return "malformed"
        if header.session != peer.session:
            if credential.incarnation <= peer.incarnation:
                return "old_introduction"
            table.events.append(PeerRestarted(peer.name, credential, table.is_home(peer.name, source)))
            return None
        if credential.encode() != peer.credential:
            table.events.append(PeerRenewed(peer.name, credential, table.is_home(peer.name, source)))
        path = table.introduced(peer, header.sender_interface, now)
        if path is None:
            return None  # counted
        number, keys, received = header.packet_number, path.keys, path.received.largest
        is_late = number <= max(received, keys.introduced)
        if is_late and (offer is None or number <= max(received, keys.offered)):
            return "duplicate"
        keys.introduced = max(keys.introduced, number)
        if table.closing:
            return None  # an answer would bring us back to life at the peer
        if path.introductions.is_full:
            return "introductions_full"
        try:
            answer = None if offer is None else path.answer_keys(offer, now)
        except TooManyExchangesError:
            return "exchanges_full"
        except DecodeError:
            return "bad_keys"
        if answer is not None:
            keys.offered = number
        elif is_late:
            return "duplicate"
        path.note_introduction(source, probe_id, answer, now)
        if path.state is PathState.DOWN:
            path.hasten_probe(now)
        table.dirty[path.id] = path
        return None


T = TypeVar("T")

DATAGRAM_BYTES = HEADER_BYTES + TAG_BYTES
"""Bytes of a datagram besides its frames."""


_BEFORE_FRESH_KEYS = (frame.Probe, frame.ProbeReply, frame.KeyOffer, frame.KeyAnswer)
"""What a path carries before the first key exchange: see `key_exchange`."""


class LinkReader:
    """Reads what one link receives."""

    __slots__ = ("_events", "_keeper", "_leads", "_mtu", "_opener", "_stats", "_table")

    def __init__(self, table: PathTable, keeper: PathKeeper, mtu: LinkMtu) -> None:
        self._table = table
        self._keeper = keeper
        self._mtu = mtu
        self._opener = LinkOpener(table)
        self._events = table.events
        self._stats = table.stats
        self._leads = table.identity.role is Role.ROBOT
        """Whether this end decides which of both ends' addresses a path uses. If each end followed the other's newest
        datagram, two ends with several addresses each could follow each other in turns forever."""

    def receive_batch(self, data: memoryview, segment: int, source: Address, now: float) -> None:
        """See `Link.receive_batch`."""
        self._stats.bytes["received"] += len(data)
        if not data:
            self._stats.dropped["malformed"] += 1
        opened = self._opener.open_batch(data, segment, source, now)
        position = 0
        while position < len(opened):
            position = self._receive_fragments(opened, position, source, now)
            if position < len(opened):
                self._receive_datagram(*opened[position], source, now)
                position += 1

    def _receive_fragments(self, opened: list[Opened], position: int, source: Address, now: float) -> int:
        """Take consecutive datagrams from `position` on that each hold a single FRAGMENT or REPAIR.

        They must be of one path and in order; returns the position of the first that is not. Nearly all datagrams of a
        long message are such. Anything odd is left to `_receive_datagram`.
        """
        path, low, _ = opened[position]
        received = path.received
        if low <= received.largest or not path.opening.phase:
            return position
        unpack, new = FRAGMENT_HEAD.unpack_from, tuple.__new__
        high = low - 1
        fragments: list[Fragment] = []
        for its_path, number, plain in islice(opened, position, None):
            size = len(plain) - FRAGMENT_HEAD_BYTES
            if size < 0 or number <= high or its_path is not path:
                break
            kind, message, total, symbol, index, left_us = unpack(plain)
            if kind == FRAGMENT_TYPE:
                length = total - index * symbol
                if length > symbol:
                    length = symbol
            elif kind == REPAIR_TYPE and symbol and is_repair_index(index, total, symbol):
                length = symbol
            else:
                break
            if (
                length != size
                or not MIN_SYMBOL_BYTES <= symbol <= MAX_SYMBOL_BYTES
                or total > MAX_MESSAGE_BYTES
                or (length <= 0 and (index or total))
            ):
                break
            if number != high + 1 and fragments:
                received.add_run(low, high, now)
                low = number
            high = number
            fragments.append(new(Fragment, (message, total, symbol, index, plain[FRAGMENT_HEAD_BYTES:], left_us)))
        if fragments:
            received.add_run(low, high, now)
            self._heard(path, source, now, newest=True)
            if not path.address.is_proven:
                size = sum(DATAGRAM_BYTES + len(plain) for _, _, plain in opened[position : position + len(fragments)])
                self._unproven(path, source, size, now)
            self._used(path, now)
            self._stats.datagrams["received", "data"] += len(fragments)
            self._hand_up(path, fragments)
            received.owe_ack(now, len(fragments))
        return position + len(fragments)

    def _heard(self, path: Path, source: Address, now: float, *, newest: bool) -> None:
        """Note an authentic datagram that is no duplicate; `newest`: sent after all that came before."""
        if newest and source != path.remote and not (self._leads and path.keeps_address(source)):
            self._keeper.follow(path, source, now)
        self._keeper.follow_keys(path, now)
        self._table.dirty[path.id] = path

    @staticmethod
    def _unproven(path: Path, source: Address, size: int, now: float) -> None:
        """Note bytes over a path to an unproven address, and ask whether the peer is there."""
        path.address.came(source, size)
        if path.state is not PathState.DOWN:
            path.probing.challenge(now)

    @staticmethod
    def _used(path: Path, now: float) -> None:
        """Note that the peer sends what it would not send over a path that is down to it."""
        if path.state is PathState.DOWN:
            path.hasten_probe(now)
        path.probing.used(now)

    def _hand_up(self, path: Path, fragments: list[Fragment]) -> None:
        """Append to the previous event, if it is of the same path and session."""
        before = self._events[-1] if self._events else None
        if isinstance(before, FragmentsReceived) and before.path is path.id and before.session == path.session:
            before.fragments.extend(fragments)
        else:
            self._events.append(FragmentsReceived(path.id, path.session, fragments))

    def _receive_datagram(self, path: Path, number: int, plain: memoryview, source: Address, now: float) -> None:
        newest = number > path.received.largest
        if not path.received.add(number, now):
            self._stats.dropped["duplicate"] += 1
            return
        try:
            frames = frame.decode_frames(plain)
        except DecodeError:
            self._stats.dropped["malformed"] += 1
            return
        self._heard(path, source, now, newest=newest)
        if not path.address.is_proven:
            self._unproven(path, source, DATAGRAM_BYTES + len(plain), now)
        self._receive_frames(path, frames, now)

    def _receive_frames(self, path: Path, frames: list[frame.Frame], now: float) -> None:
        eliciting = False
        replies = False
        events = self._events
        kind = "control"
        for item in frames:
            if not path.opening.phase and not isinstance(item, _BEFORE_FRESH_KEYS):
                self._stats.dropped["before_fresh_keys"] += 1
                continue
            match item:
                case frame.Fragment():
                    eliciting = True
                    kind = "data"
                    self._used(path, now)
                    self._hand_up(path, [item])
                case frame.AckFrame():
                    self._keeper.on_ack(path, item, now)
                case frame.Probe(probe_id) if self._table.closing:
                    pass  # an answer would bring us back to life at the peer
                case frame.Probe(probe_id):
                    path.asked(now)
                    self._table.owe(path, frame.encode_probe_reply(frame.ProbeReply(probe_id)))
                case frame.ProbeReply(probe_id):
                    replies = True
                    self._receive_reply(path, probe_id, now)
                case frame.Finished(number):
                    eliciting = True
                    events.append(MessageFinished(path.peer, number))
                case frame.Abandon(number):
                    events.append(MessageAbandoned(path.peer, path.session, number))
                case frame.Forgotten(number):
                    events.append(MessageForgotten(path.peer, number))
                case frame.Close() if path.state is not PathState.DOWN:
                    self._keeper.take_down(path, "peer closed")
                    events.append(PeerClosed(path.peer, path.session))
                case frame.Close():
                    pass
                case frame.KeyOffer():
                    self._exchange(self._keeper.keys_offered, path, item, now)
                case frame.KeyAnswer():
                    self._exchange(self._keeper.keys_answered, path, item, now)
        self._stats.datagrams["received", kind] += 1
        if path.state is PathState.DOWN and not replies:
            # It lives in this direction. A reply that fits nothing says only that it is slow: if that were a reason to
            # ask, each one would call for the next.
            path.hasten_probe(now)
        if eliciting:
            path.received.owe_ack(now)

    def _exchange(self, step: Callable[[Path, T, float], None], path: Path, item: T, now: float) -> None:
        try:
            step(path, item, now)
        except TooManyExchangesError:
            self._stats.dropped["exchanges_full"] += 1
        except DecodeError:
            self._stats.dropped["bad_keys"] += 1

    def _receive_reply(self, path: Path, probe_id: int, now: float) -> None:
        if self._mtu.answered(path, probe_id, now) or self._table.pings.answered(path, probe_id, now):
            return
        sent_at = path.answered_probe(probe_id, now)
        if sent_at is None:
            self._stats.dropped["unasked_probe_reply"] += 1
        else:
            self._keeper.probe_answered(path, sent_at, now)
