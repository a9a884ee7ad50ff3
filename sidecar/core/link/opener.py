"""Opens what one link receives: only what is authentic gets further than a counter, and in the order it came."""

from __future__ import annotations

from typing import TYPE_CHECKING

from cryptography.exceptions import InvalidTag

from protos.base.errors import DecodeError
from protos.model.ids import InterfaceId, SessionId
from sidecar.core.base.values import PathState
from sidecar.core.crypto.aead import TAG_BYTES
from sidecar.core.link.path_table import MAX_INTRODUCTIONS
from sidecar.core.path.key_exchange import TooManyExchangesError
from sidecar.core.path.keys import MAX_FAILED
from sidecar.core.seam.links import PeerRenewed, PeerRestarted
from sidecar.core.wire import frame
from sidecar.core.wire.frame import CLEAR, HEADER_BYTES, INTRODUCTION_FLAG, MIN_DATAGRAM_BYTES, NONCE_OFFSET
from sidecar.core.wire.introduction import UnauthenticError, open_introduction, read_hello_id

if TYPE_CHECKING:
    from protos.model.ids import Address
    from sidecar.core.link.path_table import PathTable
    from sidecar.core.path.path import Path
    from sidecar.core.wire.frame import Header

_OVERHEAD_BYTES = HEADER_BYTES + TAG_BYTES

Opened = tuple["Path", int, memoryview]
"""The path that an authentic datagram came over, its packet number, and its frames."""


class LinkOpener:
    """Knows whose a datagram is, and whether it is."""

    __slots__ = ("_dropped", "_table")

    def __init__(self, table: PathTable) -> None:
        self._table = table
        self._dropped = table.stats.dropped

    def open_batch(self, data: memoryview, segment: int, source: Address, now: float) -> list[Opened]:
        """Open datagrams that lie back to back, of `segment` bytes each; the last may be shorter.

        What is opened lies in one new buffer for all of them. Introductions are dealt with here.
        """
        opened: list[Opened] = []
        # Opened in place, a datagram that fails the keys of one phase would be lost to those of another.
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
        """A path's first fresh keys came into use: what was opened before is not to be read as if sealed with these."""
        fresh = [one for one in opened if one[0] is not path]
        if len(fresh) < len(opened):
            self._dropped["before_fresh_keys"] += len(opened) - len(fresh)
            opened[:] = fresh

    def _path_of(self, head: int, session: int) -> Path | None:
        """Return the path that datagrams of this clear head (the first four bytes) and session come over."""
        peer = self._table.by_session.get(SessionId(session))
        if peer is None:
            return None
        path = self._table.paths.get((peer.name, InterfaceId(head >> 8 & 0xFF)))
        if path is None or (head ^ path.opening.head) & ~(frame.PHASE_FLAG << 16):
            return None
        return path

    def _refuse(self, datagram: memoryview, source: Address, now: float) -> None:
        """Take an introduction; count anything else, which is of no path."""
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
        """Note what an introduction asks for; returns why it is dropped, or None."""
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
            return None  # an answer would bring us back to life over there
        if len(path.introductions) >= MAX_INTRODUCTIONS:
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
