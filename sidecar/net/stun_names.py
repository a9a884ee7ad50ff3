"""Turns the STUN servers' host names into addresses on a thread of its own, since a dead network's DNS takes minutes.

Names are looked up again now and then: a control plane may move.
"""

from __future__ import annotations

import logging
import socket
import threading
from typing import TYPE_CHECKING

from protos.config_fields import split_host_port
from sidecar.net.sockets import normalise

if TYPE_CHECKING:
    from collections.abc import Callable

    from protos.model import Address

log = logging.getLogger(__name__)

LOOK_UP_EVERY_S = 60.0
"""How soon a name that leads somewhere else is noticed."""
RETRY_S = 2.0
"""While some name has no address."""


class StunNames:
    """Looks up host:port names and tells the addresses whenever they change."""

    def __init__(self, found: Callable[[tuple[Address, ...]], None]) -> None:
        """`found` is called on the thread of this object."""
        self._found = found
        self._names: tuple[str, ...] = ()
        self._addresses: tuple[Address, ...] = ()
        self._failing: frozenset[str] = frozenset()
        self._wake = threading.Event()
        self._stopping = False
        self._thread = threading.Thread(target=self._run, name="plr-names", daemon=True)

    def start(self) -> None:
        """Start looking up."""
        self._thread.start()

    def stop(self) -> None:
        """End the thread; not waited for, since it may be stuck in a lookup."""
        self._stopping = True
        self._wake.set()

    def look_up(self, names: tuple[str, ...]) -> None:
        """Use these names from now on; at once, also when they are the same (the network may have changed)."""
        self._names = names
        self._wake.set()

    def _run(self) -> None:
        while not self._stopping:
            self._look_up_all()
            self._wake.wait(RETRY_S if self._failing else LOOK_UP_EVERY_S)
            self._wake.clear()

    def _look_up_all(self) -> None:
        addresses: list[Address] = []
        failing: dict[str, OSError] = {}
        for name in self._names:
            host, port = split_host_port(name)
            try:
                found = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)
            except OSError as error:
                failing[name] = error
                continue
            addresses.extend(normalise(entry[4]) for entry in found)
        for name in failing.keys() - self._failing:
            log.warning("STUN server %s: %s; trying again", name, failing[name])
        self._failing = frozenset(failing)
        unique = tuple(dict.fromkeys(addresses))
        if unique and unique != self._addresses and not self._stopping:
            self._addresses = unique
            self._found(unique)
