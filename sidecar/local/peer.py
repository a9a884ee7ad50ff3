"""Asks the kernel who is at the other end of a local socket."""

from __future__ import annotations

import socket
import struct

_SO_PEERGROUPS = 59
_MAX_GROUPS_BYTES = 1024
"""The most that Python can ask the kernel for: 256 groups."""
_CREDENTIALS = struct.Struct("iII")


def user_of(sock: socket.socket) -> int:
    """Return the user id of the peer: the client's when it connected, or the listener's when it began to listen."""
    return _credentials(sock)[1]


def groups_of(sock: socket.socket) -> set[int]:
    """Return the groups of the peer at that time."""
    own = _credentials(sock)[2]
    try:
        packed = sock.getsockopt(socket.SOL_SOCKET, _SO_PEERGROUPS, _MAX_GROUPS_BYTES)
    except OSError:  # before Linux 4.13, or more groups than anybody has
        return {own}
    return {own, *(group for (group,) in struct.iter_unpack("I", packed))}


def _credentials(sock: socket.socket) -> tuple[int, int, int]:
    process, user, group = _CREDENTIALS.unpack(
        sock.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _CREDENTIALS.size)
    )
    return process, user, group
