"""Calls sendmmsg(2) through ctypes: many datagrams in one system call, so that a flood costs its sender little.

UDP_SEGMENT would be cheaper still, but between network namespaces such runs arrive joined, as no stranger's would.
"""

from __future__ import annotations

import ctypes
import os
import struct
import time
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import socket
    from collections.abc import Sequence

BATCH = 64
"""Datagrams in one call."""


class _IoVec(ctypes.Structure):
    _fields_ = (("base", ctypes.c_void_p), ("length", ctypes.c_size_t))


class _MsgHdr(ctypes.Structure):
    _fields_ = (
        ("name", ctypes.c_void_p),
        ("name_length", ctypes.c_uint32),
        ("vectors", ctypes.POINTER(_IoVec)),
        ("vector_count", ctypes.c_size_t),
        ("control", ctypes.c_void_p),
        ("control_length", ctypes.c_size_t),
        ("flags", ctypes.c_int),
    )


class _MMsgHdr(ctypes.Structure):
    _fields_ = (("header", _MsgHdr), ("sent", ctypes.c_uint))


_sendmmsg = ctypes.CDLL(None, use_errno=True).sendmmsg


class Volley:
    """Datagrams laid out for sendmmsg once, sent as often as wanted over connected sockets."""

    def __init__(self, datagrams: Sequence[bytes]) -> None:
        self._keep = [ctypes.create_string_buffer(data, max(1, len(data))) for data in datagrams]
        self._vectors = (_IoVec * len(datagrams))()
        self._messages = (_MMsgHdr * len(datagrams))()
        for index, data in enumerate(datagrams):
            self._vectors[index] = _IoVec(ctypes.addressof(self._keep[index]), len(data))
            header = self._messages[index].header
            header.vectors = ctypes.pointer(self._vectors[index])
            header.vector_count = 1
        self._count = len(datagrams)

    def send(self, sock: socket.socket, start: int, count: int) -> int:
        """Send `count` datagrams beginning at `start` (fewer at the end); return how many left.

        Raises OSError if not even the first could be sent.
        """
        count = min(count, self._count - start)
        size = ctypes.sizeof(_MMsgHdr)
        where = ctypes.byref(self._messages, start * size)
        sent = int(_sendmmsg(sock.fileno(), where, count, 0))
        if sent < 0:
            number = ctypes.get_errno()
            raise OSError(number, os.strerror(number))
        return sent


def flood(sockets: Sequence[socket.socket], datagrams: Sequence[bytes], rate_hz: float, seconds: float) -> int:
    """Send the datagrams repeatedly at this rate, in turn over these connected sockets; return how many left.

    A closed port (ECONNREFUSED) or a full queue (ENOBUFS) does not end the flood.
    """
    volley = Volley(datagrams)
    start = time.monotonic()
    sent = turn = position = 0
    while (elapsed := time.monotonic() - start) < seconds:
        owed = int(elapsed * rate_hz) - sent
        if owed < BATCH:
            time.sleep((BATCH - owed) / rate_hz)
            continue
        try:
            gone = volley.send(sockets[turn % len(sockets)], position, BATCH)
        except OSError:
            gone = 1  # count it as sent: a failure to send must not be made up for by a burst
        turn += 1
        sent += gone
        position = (position + gone) % len(datagrams)
    return sent


assert struct.calcsize("P") == 8, "the layouts above are those of 64-bit Linux"
