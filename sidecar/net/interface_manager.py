"""Keeps a link for every usable interface: opens sockets, follows hotplug and address changes, runs STUN on each.

The interfaces are looked at every SCAN_EVERY_S. (The next version listens to netlink instead.)
"""

from __future__ import annotations

import logging
import random
import socket
import threading
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING

from protos.config_fields import split_host_port
from protos.errors import ConfigError
from protos.model import Candidate, CandidateKind, InterfaceId
from sidecar.core.datagrams import LinkIdentity
from sidecar.core.link import Link
from sidecar.core.link_events import SetReady
from sidecar.core.readiness import Readiness
from sidecar.core.stun_client import StunClient
from sidecar.core.stun_events import Failed, Mapped, MappingChanged
from sidecar.net.interface_thread import InterfaceThread
from sidecar.net.interfaces import choose, list_interfaces
from sidecar.net.sockets import normalise, open_socket

if TYPE_CHECKING:
    from collections.abc import Callable

    from protos.model import Address, InterfaceName, SessionId
    from sidecar.config import SidecarConfig
    from sidecar.core.stun_events import StunEvent
    from sidecar.net.dataplane import ThreadedDataPlane
    from sidecar.net.interfaces import Interface, SkippedInterface

log = logging.getLogger(__name__)

SCAN_EVERY_S = 2.0
"""How soon a new interface is found; a scan costs a few milliseconds of one core."""
MAX_INTERFACES = 256
"""An interface's number is one byte of the datagram's header."""
STOP_TIMEOUT_S = 1.0


@dataclass(frozen=True, slots=True)
class Identity:
    """Who this sidecar is in this run."""

    session: SessionId
    token: bytes
    incarnation: int


@dataclass(slots=True)
class _Managed:
    interface: Interface
    thread: InterfaceThread
    number: InterfaceId
    reflexive: dict[int, Address]


class InterfaceManager:
    """Owns the interface threads."""

    def __init__(
        self,
        config: SidecarConfig,
        identity: Identity,
        data_plane: ThreadedDataPlane,
        candidates_changed: Callable[[tuple[Candidate, ...]], None],
    ) -> None:
        self._config = config
        self._identity = identity
        self._data_plane = data_plane
        self._candidates_changed = candidates_changed
        self._managed: dict[InterfaceName, _Managed] = {}
        self._numbers: dict[InterfaceName, InterfaceId] = {}
        self._stun_names: tuple[str, ...] = config.stun.servers
        self._stun_servers: tuple[Address, ...] = ()
        self._candidates: tuple[Candidate, ...] = ()
        self._readiness = Readiness(stun_enabled=config.stun.enabled)
        self._skipped: dict[InterfaceName, str] = {}
        self._warned = False
        self._lock = threading.Lock()
        """Guards the addresses, which the interfaces' threads report."""
        self._look_now = threading.Event()
        self._stopping = False
        self._thread = threading.Thread(target=self._run, name="plr-interfaces", daemon=True)

    def start(self) -> None:
        """Look once, then keep looking in the background.

        Raises:
            ConfigError: an interface that the configuration names does not exist.
        """
        missing = choose(list_interfaces(), self._config.interfaces).missing
        if missing:
            existing = ", ".join(interface.name for interface in list_interfaces())
            raise ConfigError(
                "the configuration",
                "interfaces",
                f"expected an existing interface, got '{missing[0]}' (there are: {existing})",
            )
        self._scan()
        self._thread.start()

    def stop(self) -> None:
        """End the threads."""
        self._stopping = True
        self._look_now.set()
        self._thread.join(STOP_TIMEOUT_S * 2)
        for managed in list(self._managed.values()):
            managed.thread.stop(STOP_TIMEOUT_S)

    def set_stun_servers(self, names: tuple[str, ...]) -> None:
        """Use these host:port servers, unless the configuration has its own."""
        if not self._config.stun.servers and names != self._stun_names:
            self._stun_names = names
            self._look_now.set()

    def on_stun_event(self, interface: InterfaceName, event: StunEvent) -> None:
        """Take what STUN found; called on the interface's thread."""
        with self._lock:
            managed = self._managed.get(interface)
            if managed is None:
                return
            match event:
                case Mapped(family, address) | MappingChanged(family, address):
                    log.info("%s: reachable from outside as %s port %d", interface, *address)
                    managed.reflexive[family] = address
                    if self._readiness.mapped(interface, family):
                        self._set_ready(managed, ready=True)
                case Failed(family, reason, last_known):
                    self._readiness.failed(interface, family)
                    still = f"; still using {last_known[0]} port {last_known[1]}" if last_known else ""
                    log.warning("%s: STUN over IPv%d failed: %s%s; trying again", interface, family, reason, still)
        self._publish_candidates()

    # Runs on the manager's thread --------------------------------------------------------------------------------

    def _run(self) -> None:
        while True:
            self._look_now.wait(SCAN_EVERY_S)
            self._look_now.clear()
            if self._stopping:
                return
            try:
                self._scan()
            except OSError as error:
                log.warning("interfaces could not be listed: %s; trying again", error)

    def _scan(self) -> None:
        self._resolve_stun_servers()
        choice = choose(list_interfaces(), self._config.interfaces)
        self._log_skipped({skipped.name: skipped.reason for skipped in choice.skipped})
        wanted = {interface.name: interface for interface in choice.usable}
        self._drop_gone(wanted)
        changed = False
        for name, interface in wanted.items():
            managed = self._managed.get(name)
            if managed is None:
                changed |= self._add(interface)
            elif managed.interface.addresses != interface.addresses:
                self._readdress(managed, interface)
        if changed:
            links = {name: managed.thread for name, managed in self._managed.items()}
            self._data_plane.set_links(links)
        self._warn_when_none(choice.skipped)
        with self._lock:
            for name in self._readiness.after_grace(time.monotonic()):
                log.warning("%s: no STUN server answers; used without it, as far as probes succeed", name)
                self._set_ready(self._managed[name], ready=True)
        self._publish_candidates()

    def _warn_when_none(self, skipped: tuple[SkippedInterface, ...]) -> None:
        """Without any interface nothing is carried, and nothing else would say so."""
        none = not self._managed
        if none and not self._warned:
            reasons = "; ".join(f"{interface.name}: {interface.reason}" for interface in skipped) or "there are none"
            log.warning("no interface is in use, nothing can be carried (%s)", reasons)
        self._warned = none

    def _drop_gone(self, wanted: dict[InterfaceName, Interface]) -> None:
        gone = [managed for name, managed in self._managed.items() if name not in wanted]
        for managed in gone:
            name = managed.interface.name
            log.warning("%s: gone or unusable; its requests take other paths", name)
            with self._lock:
                del self._managed[name]
                self._readiness.remove(name)
        if gone:
            self._data_plane.set_links({name: managed.thread for name, managed in self._managed.items()})
        for managed in gone:
            managed.thread.stop(STOP_TIMEOUT_S)

    def _add(self, interface: Interface) -> bool:
        number = self._number(interface.name)
        if number is None:
            return False
        try:
            opened = open_socket(interface, self._config.udp_port)
        except OSError as error:
            self._log_skipped_once(interface.name, f"its socket could not be opened: {error}")
            return False
        me = self._identity
        link = Link(
            LinkIdentity(interface.name, number, me.session, me.token, me.incarnation),
            random.SystemRandom(),
            time.monotonic(),
        )
        stun = None
        if self._config.stun.enabled:
            stun = StunClient(self._stun_servers, random.SystemRandom(), drops=link.stats.dropped)
            stun.start(time.monotonic())
        thread = InterfaceThread(opened.socket, link, stun, self._data_plane)
        with self._lock:
            managed = self._managed[interface.name] = _Managed(interface, thread, number, {})
            self._set_ready(managed, ready=self._readiness.add(interface.name, time.monotonic()))
        thread.start()
        log.info(
            "%s: in use, port %d, bound to the %s, addresses %s",
            interface.name, thread.port, opened.bound_to, ", ".join(interface.addresses),
        )  # fmt: skip
        return True

    def _readdress(self, managed: _Managed, interface: Interface) -> None:
        log.info("%s: addresses changed to %s", interface.name, ", ".join(interface.addresses))
        with self._lock:
            managed.interface = interface
            managed.reflexive.clear()
        managed.thread.post(lambda stun: stun.start(time.monotonic()))
        managed.thread.wake()

    def _number(self, name: InterfaceName) -> InterfaceId | None:
        if name not in self._numbers:
            if len(self._numbers) >= MAX_INTERFACES:
                self._log_skipped_once(name, f"more than {MAX_INTERFACES} interfaces came and went in this run")
                return None
            self._numbers[name] = InterfaceId(len(self._numbers))
        return self._numbers[name]

    def _set_ready(self, managed: _Managed, *, ready: bool) -> None:
        managed.thread.post(SetReady(ready))
        managed.thread.wake()

    def _resolve_stun_servers(self) -> None:
        """Host names are looked up here, on a thread that nothing waits for."""
        servers: list[Address] = []
        for name in self._stun_names:
            host, port = split_host_port(name)
            try:
                found = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)
            except OSError as error:
                log.warning("STUN server %s: %s; trying again", name, error)
                continue
            servers.extend(normalise(entry[4]) for entry in found)
        resolved = tuple(dict.fromkeys(servers))
        if resolved and resolved != self._stun_servers:
            self._stun_servers = resolved
            for managed in self._managed.values():
                managed.thread.post(lambda stun: stun.set_servers(resolved, time.monotonic()))
                managed.thread.wake()

    def _publish_candidates(self) -> None:
        with self._lock:
            candidates = tuple(candidate for managed in self._managed.values() for candidate in self._of(managed))
            if candidates == self._candidates:
                return
            self._candidates = candidates
        self._candidates_changed(candidates)

    def _of(self, managed: _Managed) -> list[Candidate]:
        name, number, port = managed.interface.name, managed.number, managed.thread.port
        hosts = [(address, port) for address in managed.interface.addresses]
        for advertised in self._config.advertise:
            first = next(iter(self._managed), None)
            if (advertised.interface or first) == name:
                hosts.append((advertised.address, port))
        found = [Candidate(number, name, CandidateKind.HOST, address) for address in hosts]
        found.extend(
            Candidate(number, name, CandidateKind.SERVER_REFLEXIVE, address)
            for address in managed.reflexive.values()
            if address not in hosts
        )
        return found

    def _log_skipped(self, skipped: dict[InterfaceName, str]) -> None:
        for name, reason in skipped.items():
            self._log_skipped_once(name, reason)
        for name in [name for name in self._skipped if name in self._managed]:
            del self._skipped[name]

    def _log_skipped_once(self, name: InterfaceName, reason: str) -> None:
        if self._skipped.get(name) != reason:
            self._skipped[name] = reason
            log.info("%s: not used: %s", name, reason)
