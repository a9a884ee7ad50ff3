"""Resolves host names on a thread of its own, since a dead network's DNS takes minutes.

Names are looked up again periodically, as their hosts may move. A name that cannot be looked up keeps its addresses.
"""

from __future__ import annotations

import logging
import socket
import threading
import time
from typing import TYPE_CHECKING

from plr.protos.base.host_port import numeric_host, split_host_port
from plr.protos.base.token_bucket import TokenBucket
from plr.sidecar.net.sockets import normalise

if TYPE_CHECKING:
    from collections.abc import Callable

    from plr.protos.model.ids import Address

log = logging.getLogger(__name__)

LOOK_UP_EVERY_S = 60.0
"""Interval of the lookups: a name that leads elsewhere is noticed within this time."""
RETRY_S = 2.0
"""The same while some name has no address."""
NEW_NAMES_PER_S = 0.1
"""Rate at which new sets of names are used, as their sender decides whom we contact; before that ..."""
NEW_NAMES_AT_ONCE = 4.0
"""... this many at once: those of the configuration, of the control plane, of the next one."""
HELD_BACK_S = 1.0
"""Interval of checks whether new names may be used."""


class HostNames:
    """Looks up host:port names and reports all their addresses whenever these change."""

    def __init__(self, what: str, found: Callable[[tuple[Address, ...]], None]) -> None:
        """Start without names. `what` describes them in the log; `found` is called on this object's thread."""
        self._what = what
        self._found = found
        self._names: tuple[str, ...] = ()
        self._by_name: dict[str, tuple[Address, ...]] = {}
        self._told: tuple[Address, ...] = ()
        self._failing: frozenset[str] = frozenset()
        self._used: tuple[str, ...] = ()
        self._changes = TokenBucket(rate=NEW_NAMES_PER_S, burst=NEW_NAMES_AT_ONCE, now=time.monotonic())
        self._wake = threading.Event()
        self._stopping = False
        self._thread = threading.Thread(target=self._run, name="plr-names", daemon=True)

    def start(self) -> None:
        """Start looking up."""
        self._thread.start()

    def stop(self) -> None:
        """End the thread without waiting for it, since it may be stuck in a lookup."""
        self._stopping = True
        self._wake.set()

    def look_up(self, names: tuple[str, ...]) -> None:
        """Use these names and look them up at once, even if they are the same: the network may have changed.

        New names that come too often wait.
        """
        self._names = names
        self._wake.set()

    def _run(self) -> None:
        while not self._stopping:
            if self._names == self._used or self._changes.take(time.monotonic()):
                self._used = self._names
                self._look_up_all()
                self._wake.wait(RETRY_S if self._failing else LOOK_UP_EVERY_S)
            else:
                self._wake.wait(HELD_BACK_S)
            self._wake.clear()

    def _look_up_all(self) -> None:
        names = self._used
        self._by_name = {name: self._by_name[name] for name in names if name in self._by_name}
        self._by_name |= {name: (address,) for name in names if (address := numeric_host(name)) is not None}
        self._tell()  # numeric ones need not wait for a name server that does not answer
        failing: dict[str, OSError] = {}
        for name in names:
            if numeric_host(name) is not None:
                continue
            host, port = split_host_port(name)
            try:
                found = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)
            except OSError as error:
                failing[name] = error
                continue
            self._by_name[name] = tuple(normalise(entry[4]) for entry in found)
            self._tell()
        for name in failing.keys() - self._failing:
            log.warning("%s %s: %s; trying again", self._what, name, failing[name])
        self._failing = frozenset(failing)

    def _tell(self) -> None:
        unique = tuple(dict.fromkeys(address for name in self._used for address in self._by_name.get(name, ())))
        if unique and unique != self._told and not self._stopping:
            self._told = unique
            self._found(unique)
