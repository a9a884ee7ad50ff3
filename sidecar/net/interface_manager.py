"""Keeps a link for every usable interface: opens sockets, follows hotplug and address changes, runs STUN on each.

The kernel announces changes (`netlink_watch`). All interfaces are scanned after each one, and rarely without any.
"""

from __future__ import annotations

import logging
import threading
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING

from plr.protos.model.ids import InterfaceId, InterfaceName
from plr.sidecar.core.interfaces.readiness import Readiness
from plr.sidecar.core.interfaces.scan_schedule import WITHOUT_NEWS_S, ScanSchedule
from plr.sidecar.core.link.sender import LinkIdentity
from plr.sidecar.core.path.key_exchange import KeyLimits
from plr.sidecar.core.stun.events import Failed, Mapped, MappingChanged
from plr.sidecar.net.host_names import HostNames
from plr.sidecar.net.interfaces import choose, list_interfaces, missing_interfaces
from plr.sidecar.net.managed_interface import STOP_TIMEOUT_S, ManagedInterface
from plr.sidecar.net.netlink_watch import NetlinkWatch

if TYPE_CHECKING:
    from collections.abc import Callable

    from plr.protos.model.ids import Address
    from plr.protos.model.members import Candidate
    from plr.sidecar.config.sidecar import SidecarConfig
    from plr.sidecar.core.crypto.session import OwnSession
    from plr.sidecar.core.link.memory import LinkMemory
    from plr.sidecar.core.stun.client import StunView
    from plr.sidecar.core.stun.events import StunEvent
    from plr.sidecar.net.dataplane import ThreadedDataPlane
    from plr.sidecar.net.interface_thread import InterfaceThread
    from plr.sidecar.net.interfaces import Interface, InterfaceChoice

log = logging.getLogger(__name__)

MAX_INTERFACES = 256
"""Most interfaces: an interface's number is one byte of the datagram's header."""
GRACE_CHECK_S = 0.5
"""While an interface waits for STUN, interval of checks whether STUN answers any interface."""
ERROR_PAUSE_S = 0.1
"""Pause after an error, which may recur at every turn."""
COALESCE_S = 0.005
"""Pause between two reads of a flood of announcements: each costs a turn of the interpreter that all threads share."""


@dataclass(frozen=True, slots=True)
class InterfaceView:
    """One interface in use at one moment, for display."""

    name: InterfaceName
    suspended: bool
    """Whether it can carry nothing now."""
    addresses: tuple[str, ...]
    families: frozenset[int]
    port: int
    mtu: int
    bound_to: str
    hangs: int
    """Number of times that its driver did not return for long."""
    stun: tuple[StunView, ...]


@dataclass(slots=True)
class _Number:
    """An interface's number in this run, kept while it is away, with what its next link must know about its last."""

    id: InterfaceId
    memory: LinkMemory | None = None


class InterfaceManager:
    """Owns the interface threads."""

    def __init__(
        self,
        config: SidecarConfig,
        own: OwnSession,
        token: bytes,
        data_plane: ThreadedDataPlane,
        candidates_changed: Callable[[tuple[Candidate, ...], tuple[InterfaceName, ...]], None],
    ) -> None:
        self._config = config
        self._own = own
        self._token = token
        self._limits = KeyLimits(seconds=config.rekey_after_s)
        self._data_plane = data_plane
        self._candidates_changed = candidates_changed
        self._managed: dict[InterfaceName, ManagedInterface] = {}
        self._numbers: dict[InterfaceName, _Number] = {}
        self._stun_names: tuple[str, ...] = config.stun.servers
        self._stun_servers: tuple[Address, ...] = ()
        self._resolver = HostNames("STUN server", self._use_stun_servers)
        self._candidates: tuple[Candidate, ...] = ()
        self._down: tuple[InterfaceName, ...] = ()
        self._readiness = Readiness(stun_enabled=config.stun.enabled)
        self._skipped: dict[InterfaceName, str] = {}
        self._idle: frozenset[InterfaceName] = frozenset()
        """Wanted interfaces that were missing or could carry nothing at the last scan."""
        self._warned = False
        self._refused: dict[InterfaceName, str] = {}
        """Usable interfaces whose sockets could not be opened at the last scan, and why. Replaced, never changed."""
        self._lock = threading.Lock()
        """Guards the addresses, which the interfaces' threads report."""
        self._watch = NetlinkWatch()
        self._schedule = ScanSchedule(time.monotonic(), has_news=False)
        self._stopping = False
        self._thread = threading.Thread(target=self._run, name="plr-interfaces", daemon=True)

    def start(self) -> None:
        """Scan once, then keep scanning in the background. An interface that is missing is used as soon as it comes."""
        described = [network.interface for network in self._config.networks]
        for line in missing_interfaces(list_interfaces(), self._config.interfaces, described):
            log.warning("%s", line)
        try:
            self._watch.subscribe()
            self._schedule = ScanSchedule(time.monotonic(), has_news=True)
        except OSError as error:
            log.warning(
                "the kernel does not announce changes of interfaces (%s): they are checked every %g s",
                error,
                WITHOUT_NEWS_S,
            )
        if self._config.stun.enabled:
            self._resolver.look_up(self._stun_names)
            self._resolver.start()
        self._scan()
        self._thread.start()

    def stop(self) -> None:
        """End the threads."""
        self._stopping = True
        self._resolver.stop()
        self._watch.wake()
        self._thread.join(STOP_TIMEOUT_S * 2)
        for managed in list(self._managed.values()):
            managed.stop()
        if not self._thread.is_alive():
            self._watch.close()

    def set_stun_servers(self, names: tuple[str, ...]) -> None:
        """Use these host:port servers, unless the configuration has its own."""
        if not self._config.stun.servers and names != self._stun_names:
            self._stun_names = names
            self._resolver.look_up(names)

    @property
    def stun_servers(self) -> tuple[str, ...]:
        """The STUN servers in use, as host:port; from any thread."""
        return self._stun_names

    def in_use(self) -> dict[InterfaceName, bool]:
        """Return the interfaces that are wanted, and whether each can carry something; from any thread."""
        states = dict.fromkeys([*self._idle, *self._refused], False)
        return states | {name: not managed.suspended for name, managed in list(self._managed.items())}

    def unopened(self) -> dict[InterfaceName, str]:
        """Return the interfaces whose sockets could not be opened, and why; from any thread."""
        return self._refused

    def views(self) -> list[InterfaceView]:
        """Return the state of the interfaces in use; from any thread."""
        with self._lock:
            managed = [(one, one.interface) for one in self._managed.values()]
        return [
            InterfaceView(
                one.name,
                one.suspended,
                interface.addresses,
                interface.families,
                one.thread.port,
                interface.mtu,
                str(one.bound_to),
                one.thread.link.stats.hangs,
                () if one.thread.stun is None else tuple(one.thread.stun.views()),
            )
            for one, interface in managed
        ]

    def _on_stun(self, interface: InterfaceName, event: StunEvent) -> None:
        """Take a STUN event; called on the interface's thread."""
        with self._lock:
            managed = self._managed.get(interface)
            if managed is None:
                return
            match event:
                case Mapped(family, address) | MappingChanged(family, address):
                    log.info("%s: reachable from outside as %s port %d", interface, *address)
                    managed.reflexive[family] = address
                    if self._readiness.mapped(interface, family):
                        managed.set_ready()
                case Failed(family, reason, last_known):
                    self._readiness.failed(interface, family)
                    if not managed.suspended:
                        still = f"; still using {last_known[0]} port {last_known[1]}" if last_known else ""
                        log.warning("%s: STUN over IPv%d failed: %s%s; trying again", interface, family, reason, still)
        self._publish_candidates()

    def _use_stun_servers(self, servers: tuple[Address, ...]) -> None:
        """Use these looked-up STUN servers; called on the resolver's thread."""
        with self._lock:
            self._stun_servers = servers
            for managed in self._managed.values():
                managed.set_stun_servers(servers)

    # Runs on the manager's thread --------------------------------------------------------------------------------

    def _run(self) -> None:
        while not self._stopping:
            self._turn(self._wait_s())

    def _wait_s(self) -> float:
        wait_s = self._schedule.due - time.monotonic()
        return min(wait_s, GRACE_CHECK_S) if self._readiness.waiting else wait_s

    def _turn(self, wait_s: float) -> None:
        try:
            changes = self._watch.wait(wait_s)
            if self._stopping:
                return
            if changes.gone_links:
                self._suspend_links(changes.gone_links)
            if changes.any:
                self._schedule.changed(time.monotonic())
            if self._schedule.due <= time.monotonic():
                self._scan()
            elif changes.any:
                time.sleep(COALESCE_S)
            self._let_late_ones_begin()
        except OSError as error:
            log.warning("interfaces could not be listed: %s; trying again", error)
            self._schedule.failed(time.monotonic())
            time.sleep(ERROR_PAUSE_S)
        except Exception:
            # A sidecar that stops following its interfaces is as bad as a dead one, and harder to notice.
            log.exception("internal error; the interfaces are scanned again")
            self._schedule.failed(time.monotonic())
            time.sleep(ERROR_PAUSE_S)

    def _suspend_links(self, indices: frozenset[int]) -> None:
        """Suspend these links before any scan: their requests take other paths now, not after the next scan."""
        for managed in self._managed.values():
            if managed.interface.index in indices and not managed.suspended:
                self._suspend(managed, "no carrier")

    def _suspend(self, managed: ManagedInterface, reason: str) -> None:
        log.warning("%s: %s; its requests take other paths", managed.name, reason)
        with self._lock:
            managed.suspend(reason)

    def _scan(self) -> None:
        started = time.monotonic()
        choice = choose(list_interfaces(), self._config.interfaces)
        self._log_skipped(choice)
        self._drop_gone(choice)
        changed = added = False
        refused: dict[InterfaceName, str] = {}
        for interface in choice.usable:
            managed = self._managed.get(interface.name)
            if managed is None:
                added |= self._add(interface, refused)
            else:
                changed |= self._update(managed, interface)
        if added:
            self._data_plane.set_links(self._links())
        if (changed or added) and self._config.stun.enabled:
            self._resolver.look_up(self._stun_names)  # this network's DNS may know what the last one did not
        idle = {skipped.name for skipped in choice.skipped if skipped.wanted}
        self._idle = frozenset(idle.union(map(InterfaceName, choice.missing)))
        self._refused = refused
        self._warn_when_none(choice)
        self._publish_candidates()
        self._schedule.scanned(started, time.monotonic())
        if refused:
            self._schedule.failed(time.monotonic())

    def _drop_gone(self, choice: InterfaceChoice) -> None:
        """Suspend interfaces that cannot carry now; drop those that are gone or are another device now."""
        usable = {interface.name: interface for interface in choice.usable}
        idle = {skipped.name: skipped for skipped in choice.skipped if skipped.wanted}
        gone: list[ManagedInterface] = []
        for name, managed in list(self._managed.items()):
            now_usable, now_idle = usable.get(name), idle.get(name)
            if now_usable is not None:
                keep = not managed.must_reopen(now_usable)
            else:
                keep = now_idle is not None and now_idle.index == managed.interface.index
            if not keep:
                log.warning("%s: removed, or another device now; its requests take other paths", name)
                with self._lock:
                    del self._managed[name]
                    self._readiness.remove(name)
                gone.append(managed)
            elif now_idle is not None and not managed.suspended:
                self._suspend(managed, now_idle.reason)
        if gone:
            self._data_plane.set_links(self._links())
        for managed in gone:
            self._numbers[managed.name].memory = managed.stop()

    def _add(self, interface: Interface, refused: dict[InterfaceName, str]) -> bool:
        """Use an interface and return True; if its socket cannot be opened, note why in `refused`."""
        number = self._number(interface.name)
        if number is None:
            return False
        identity = LinkIdentity.of(self._own.credential, self._token, interface.name, number.id)
        with self._lock:
            servers = self._stun_servers if self._config.stun.enabled else None
            try:
                managed = ManagedInterface(
                    interface,
                    self._config.udp_port,
                    identity,
                    number.memory,
                    self._limits,
                    servers,
                    self._data_plane,
                    self._on_stun,
                )
            except OSError as error:
                why = f"its socket could not be opened: {error.strerror or error}"
                if self._config.udp_port:
                    why += f" (udp_port {self._config.udp_port})"
                refused[interface.name] = why
                self._log_skipped_once(interface.name, why)
                return False
            self._managed[interface.name] = managed
            if self._readiness.add(interface.name, interface.families, time.monotonic()):
                managed.set_ready()
        managed.thread.start()
        log.info(
            "%s: in use, port %d, bound to the %s, addresses %s",
            interface.name, managed.thread.port, managed.bound_to, ", ".join(interface.addresses),
        )  # fmt: skip
        return True

    def _update(self, managed: ManagedInterface, interface: Interface) -> bool:
        was = managed.interface
        back = managed.suspended
        with self._lock:
            changed = managed.update(interface)
            self._readiness.set_families(interface.name, interface.families)
        if back:
            log.info("%s: back, addresses %s", interface.name, ", ".join(interface.addresses))
        elif set(interface.addresses) != set(was.addresses):
            log.info("%s: addresses changed to %s", interface.name, ", ".join(interface.addresses))
        elif interface.gateways != was.gateways:
            log.info(
                "%s: gateways changed to %s",
                interface.name,
                ", ".join(hop or "no hop" for _, hop in interface.gateways) or "none",
            )
        return changed

    def _links(self) -> dict[InterfaceName, InterfaceThread]:
        return {name: managed.thread for name, managed in self._managed.items()}

    def _let_late_ones_begin(self) -> None:
        with self._lock:
            for name in self._readiness.after_grace(time.monotonic()):
                log.warning("%s: no STUN server answers; the interface is used without STUN where probes succeed", name)
                self._managed[name].set_ready()

    def _warn_when_none(self, choice: InterfaceChoice) -> None:
        """Warn when no interface is in use: nothing is carried then, and nothing else would say so."""
        none = all(managed.suspended for managed in self._managed.values())
        if none and not self._warned:
            reasons = [f"{interface.name}: {interface.reason}" for interface in choice.skipped]
            reasons += [f"{name}: there is no such interface" for name in choice.missing]
            reasons += [f"{name}: {why}" for name, why in self._refused.items()]
            log.warning(
                "no interface is in use, so no request can be carried (%s)", "; ".join(reasons) or "there are none"
            )
        self._warned = none

    def _number(self, name: InterfaceName) -> _Number | None:
        if name not in self._numbers:
            if len(self._numbers) >= MAX_INTERFACES:
                self._log_skipped_once(name, f"more than {MAX_INTERFACES} interfaces came and went in this run")
                return None
            self._numbers[name] = _Number(InterfaceId(len(self._numbers)))
        return self._numbers[name]

    def _publish_candidates(self) -> None:
        with self._lock:
            candidates: list[Candidate] = []
            for managed in self._managed.values():
                candidates += managed.candidates(self._advertised(managed.name))
            down = self._carry_nothing()
            if (tuple(candidates), down) == (self._candidates, self._down):
                return
            self._candidates, self._down = tuple(candidates), down
        self._candidates_changed(self._candidates, self._down)

    def _carry_nothing(self) -> tuple[InterfaceName, ...]:
        """Return the interfaces that carry nothing but should: named in the configuration, or used earlier in this run.

        A port that was never plugged in is no problem where all interfaces are used, or a glob matches it.
        """
        named = self._config.interfaces or ()
        idle = {name for name in (*self._idle, *self._refused) if name in named or name in self._numbers}
        suspended = {name for name, managed in self._managed.items() if managed.suspended}
        return tuple(sorted(idle | suspended))

    def _advertised(self, name: InterfaceName) -> list[str]:
        first = next(iter(self._managed), None)
        return [entry.address for entry in self._config.advertise if (entry.interface or first) == name]

    def _log_skipped(self, choice: InterfaceChoice) -> None:
        for skipped in choice.skipped:
            if skipped.name not in self._managed:
                self._log_skipped_once(skipped.name, skipped.reason)
        there = {usable.name for usable in choice.usable} | {skipped.name for skipped in choice.skipped}
        there -= self._managed.keys()
        self._skipped = {name: reason for name, reason in self._skipped.items() if name in there}

    def _log_skipped_once(self, name: InterfaceName, reason: str) -> None:
        if self._skipped.get(name) != reason:
            self._skipped[name] = reason
            log.info("%s: not used: %s", name, reason)
