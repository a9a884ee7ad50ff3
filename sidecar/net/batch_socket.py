"""Moves runs of datagrams through one UDP socket by segmentation in the kernel (udp(7), UDP_SEGMENT and UDP_GRO).

One system call then moves up to 64 datagrams. Where the kernel or the device has no segmentation, or refuses it later,
datagrams are sent one by one. Datagrams that arrive one by one are laid side by side, so that the link still gets runs.
"""

from __future__ import annotations

import errno
import logging
import socket
import struct
import sys
from typing import TYPE_CHECKING, Any, NamedTuple

from plr.sidecar.core.link.sender import Batch
from plr.sidecar.net.sockets import normalise, to_sockaddr

if TYPE_CHECKING:
    from collections.abc import Callable

    from plr.protos.model.ids import Address
    from plr.sidecar.core.seam.stats import LinkStats

    _SockAddr = tuple[str, int] | tuple[str, int, int, int]

log = logging.getLogger(__name__)

ROOM_BYTES = 1 << 16
"""Room for one call, more than the longest UDP payload and the longest run that the kernel joins: nothing is ever
truncated."""
ARENA_BYTES = 256 * 1024
"""Most bytes received in one turn, four of the longest runs: one or two milliseconds of work, and it fits the cache."""
RECEIVE_CALLS = 64
"""Most system calls of one turn, for the many small datagrams that the kernel does not join."""

# Constants of linux/udp.h that the socket module lacks.
_UDP_SEGMENT = 103
_UDP_GRO = 104
_ANCILLARY_BYTES = socket.CMSG_SPACE(4)

_PERHAPS_SEGMENTATION = frozenset({errno.EIO, errno.EINVAL, errno.EMSGSIZE, errno.EOPNOTSUPP, errno.ENOPROTOOPT})
"""Errors with which a kernel refuses to segment. The datagram itself may be at fault: only sending it alone shows."""


class DatagramRun(NamedTuple):
    """Datagrams of one sender, contiguous in memory: `segment` bytes each, the last may be shorter."""

    data: memoryview
    segment: int
    source: Address


class BatchSocket:
    """Sends and receives runs over a non-blocking UDP socket; used by one thread."""

    def __init__(self, sock: socket.socket, stats: LinkStats, on_too_big: Callable[[Address, int], None]) -> None:
        """Use `sock`; `on_too_big` gets the destination and size (bytes) of datagrams too long for the way out."""
        self._socket = sock
        self._stats = stats
        self._dropped = stats.dropped
        self._on_too_big = on_too_big
        self._segments = _has_segmentation(sock)
        stats.offload["send"] = self._segments
        stats.offload["receive"] = _turn_on_joining(sock)
        self._arena = memoryview(bytearray(ARENA_BYTES))
        self._ancillary: tuple[int, list[tuple[int, int, bytes]]] = (0, [])

    def send(self, batch: Batch) -> Batch | None:
        """Send a batch; return what has to wait because the socket's buffer is full.

        Datagrams that the kernel refuses for other reasons are counted and dropped: for the sender they are lost.
        """
        address, data, segment = batch
        destination = to_sockaddr(self._socket.family, address)
        if destination is None:
            self._drop(errno.EAFNOSUPPORT, batch.datagrams)
            return None
        if not self._segments or len(data) <= segment:
            return self._send_each(batch, destination)
        if self._ancillary[0] != segment:
            self._ancillary = segment, [(socket.IPPROTO_UDP, _UDP_SEGMENT, struct.pack("=H", segment))]
        try:
            self._socket.sendmsg((data,), self._ancillary[1], 0, destination)
        except BlockingIOError:
            self._dropped["send_buffer_full_waits"] += 1
            return batch
        except OSError as error:
            if error.errno in _PERHAPS_SEGMENTATION:
                return self._send_each(batch, destination, refused=error)
            self._drop(error.errno, batch.datagrams)
        return None

    def receive(self, at_most: int = RECEIVE_CALLS) -> list[DatagramRun]:
        """Return what has arrived, by at most so many system calls; the views are valid until the next call."""
        arena, receive = self._arena, self._socket.recvmsg_into
        runs: list[DatagramRun] = []
        start = end = segment = 0
        sender: tuple[Any, ...] = ()
        for _ in range(at_most):
            if end > ARENA_BYTES - ROOM_BYTES:
                break
            try:
                size, ancillary, _, source = receive((arena[end : end + ROOM_BYTES],), _ANCILLARY_BYTES)
            except BlockingIOError:
                break
            except OSError as error:
                # ICMP errors of earlier sends surface here; the paths' own probes are decisive.
                self._dropped[f"receive_{_name(error.errno)}"] += 1
                continue
            if not size:
                self._dropped["malformed"] += 1
                continue
            joined = int.from_bytes(ancillary[0][2], sys.byteorder) if ancillary else size
            extends = (
                source == sender
                and (end - start) % segment == 0
                and (joined == segment or (size < segment and not ancillary))
            )
            if not extends:
                if end > start:
                    runs.append(DatagramRun(arena[start:end], segment, normalise(sender)))
                start, segment, sender = end, joined, source
            end += size
        if end > start:
            runs.append(DatagramRun(arena[start:end], segment, normalise(sender)))
        return runs

    def _send_each(self, batch: Batch, destination: _SockAddr, refused: OSError | None = None) -> Batch | None:
        """Send datagrams one by one; after `refused`, the first that leaves proves that segmentation was at fault."""
        address, data, segment = batch
        view = memoryview(data)
        told = False
        for start in range(0, len(data), segment):
            piece = view[start : start + segment]
            try:
                self._socket.sendto(piece, destination)
            except BlockingIOError:
                self._dropped["send_buffer_full_waits"] += 1
                return Batch(address, view[start:], segment)
            except OSError as error:
                self._drop(error.errno, 1)
                if error.errno == errno.EMSGSIZE and not told:
                    told = True  # all are equally long, except the last
                    self._on_too_big(address, len(piece))
                continue
            # A shorter last datagram proves nothing: it may fit where the others are too long.
            if refused is not None and len(piece) == segment:
                self._stop_segmenting(refused)
                refused = None
        return None

    def _stop_segmenting(self, error: OSError) -> None:
        log.info(
            "%s: the kernel does not segment datagrams (%s): they are sent one by one from now on",
            self._stats.interface,
            error.strerror,
        )
        self._segments = self._stats.offload["send"] = False

    def _drop(self, error: int | None, count: int) -> None:
        self._dropped[f"unsendable_{_name(error)}"] += count


def _has_segmentation(sock: socket.socket) -> bool:
    """Return whether the kernel segments (since Linux 4.18). A device's refusal shows only when it has to send."""
    try:
        sock.getsockopt(socket.IPPROTO_UDP, _UDP_SEGMENT)
    except OSError:
        return False
    return True


def _turn_on_joining(sock: socket.socket) -> bool:
    """Let the kernel join datagrams (since Linux 5.0); return whether it does."""
    try:
        sock.setsockopt(socket.IPPROTO_UDP, _UDP_GRO, 1)
    except OSError:
        return False
    return True


def _name(error: int | None) -> str:
    return errno.errorcode.get(error or 0, "error").lower()
