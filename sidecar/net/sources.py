"""Finds the address of ours that the kernel sends from towards a path's end, by a socket that never sends."""

from __future__ import annotations

import socket
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from plr.protos.model.ids import Address

_DEVICE_NAME_BYTES = 16
"""IFNAMSIZ of linux/if.h."""
_UNBOUND = frozenset({"0.0.0.0", "::"})  # noqa: S104 - compared with, not bound to


class Sources:
    """Finds source addresses for one data socket."""

    __slots__ = ("_bound", "_device")

    def __init__(self, sock: socket.socket) -> None:
        host: str = sock.getsockname()[0]
        self._bound = None if host in _UNBOUND else host
        self._device = sock.getsockopt(socket.SOL_SOCKET, socket.SO_BINDTODEVICE, _DEVICE_NAME_BYTES)

    def towards(self, address: Address) -> str | None:
        """Return our address from which datagrams to `address` leave; None when there is no way there."""
        if self._bound is not None:
            return self._bound
        family = socket.AF_INET6 if ":" in address[0] else socket.AF_INET
        try:
            with socket.socket(family, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC) as asked:
                if self._device.strip(b"\0"):
                    asked.setsockopt(socket.SOL_SOCKET, socket.SO_BINDTODEVICE, self._device)
                asked.connect(address)
                host: str = asked.getsockname()[0]
                return host
        except OSError:
            return None
