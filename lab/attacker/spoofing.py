"""Sends UDP datagrams with a forged source from raw sockets (raw(7)); no network here filters them."""

from __future__ import annotations

import contextlib
import socket
from typing import TYPE_CHECKING

from lab.attacker.wire import ETHERNET_BYTES, Captured

if TYPE_CHECKING:
    from plr.protos.model.ids import Address

THIRD_PARTYS_PORT = 4000


class Spoofer:
    """Sends datagrams with a forged source."""

    def __init__(self) -> None:
        self._sockets = {
            family: socket.socket(family, socket.SOCK_RAW, socket.IPPROTO_RAW)
            for family in (socket.AF_INET, socket.AF_INET6)
        }

    def send(self, datagram: bytes, claimed: tuple[str, str], to: Address) -> None:
        """Send a datagram to an address, from the `claimed` address (IPv4, IPv6) of its family."""
        six = ":" in to[0]
        made = Captured("", bytes(ETHERNET_BYTES), (claimed[six], THIRD_PARTYS_PORT), to, datagram, outgoing=True)
        with contextlib.suppress(OSError):  # a full queue
            self._sockets[socket.AF_INET6 if six else socket.AF_INET].sendto(made.frame()[ETHERNET_BYTES:], (to[0], 0))
