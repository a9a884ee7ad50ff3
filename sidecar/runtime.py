"""Assembles one sidecar: state on disk, data plane, interfaces, ROS bridge, control client, metrics."""

from __future__ import annotations

import logging
import os
import random
import threading
import time
from dataclasses import replace
from typing import TYPE_CHECKING

from plr.protos.base.errors import StartError
from plr.protos.base.host_port import split_host_port
from plr.protos.model.ids import OLDEST_PROTOCOL_VERSION, PROTOCOL_VERSION, Role, ServiceName, Version
from plr.protos.model.mapping import MappingSet
from plr.protos.model.members import MAX_UNMET, CandidateKind, Registration, ServiceSet
from plr.protos.model.stream import ResourceKind
from plr.protos.program import interpreter
from plr.protos.program.notifier import Notifier
from plr.protos.program.tls_files import TlsWatch, load_tls_files
from plr.protos.trust.clock_floor import ClockFloor
from plr.sidecar.control.announcement import Announcer
from plr.sidecar.control.client import ControlClient
from plr.sidecar.control.revocations import Revocations
from plr.sidecar.core.control.session import Apply, ControlSession
from plr.sidecar.core.control.ways import ControlInterface
from plr.sidecar.core.engine.engine import EngineConfig
from plr.sidecar.local.server import LocalSocketError, LocalSocketServer
from plr.sidecar.local.state import LocalState, MappingOrigin
from plr.sidecar.net.control_dialer import ControlDialer
from plr.sidecar.net.dataplane import DataPlaneHooks, ThreadedDataPlane
from plr.sidecar.net.interface_manager import InterfaceManager
from plr.sidecar.observe.metrics import MetricSources, serve_metrics
from plr.sidecar.observe.unmet_services import UnmetServices, told, told_mismatched, told_unreached
from plr.sidecar.ros.bridge import RosBridge
from plr.sidecar.state.start_session import signed, start_session
from plr.sidecar.state.store import StateDirError, StateStore

if TYPE_CHECKING:
    from collections.abc import Mapping

    from plr.protos.model.ids import InterfaceName, NodeName
    from plr.protos.model.mapping import Assignment
    from plr.protos.model.members import Candidate, PeerSet
    from plr.protos.model.stream import Welcome
    from plr.protos.program.metrics_server import MetricsServer
    from plr.protos.program.tls_files import TlsFiles
    from plr.sidecar.config.sidecar import SidecarConfig
    from plr.sidecar.core.base.values import PathState
    from plr.sidecar.core.link.pinging import Pong
    from plr.sidecar.stop_request import StopRequest

log = logging.getLogger(__name__)

DRAIN_S = 5.0
"""How long requests in flight get on SIGTERM."""
DRAIN_POLL_S = 0.02
STATUS_EVERY_S = 2.0
"""How often the status line of `systemctl status` is renewed."""
MAX_STATUS_CHARACTERS = 500
"""Maximum length of the status line: names of services may be long."""
DEFAULT_STUN_PORT = 3478
"""RFC 8489 section 8; used on the control plane's hosts when no STUN server is named."""


class SidecarRuntime:
    """All parts of one sidecar; also implements the control client's `ControlHooks`."""

    def __init__(self, config: SidecarConfig, version: str) -> None:
        self._config = config
        self._tls = TlsWatch(load_tls_files(config.tls_dir)) if config.tls_dir is not None else None
        self._store = _open_store(config)
        identity = self._store.identity
        tls = self._tls
        self._clock = ClockFloor(time.time, self._store.clock_floor, self._store.remember_clock_floor, log.error)
        own = start_session(
            config.node_name,
            config.role,
            identity.incarnation,
            None if tls is None else lambda: tls.current,
            self._clock,
            config.max_revocation_age,
        )
        self._own = own
        self._announcer = Announcer(own.credential.session, None if tls is None else lambda: tls.current, config.labels)
        self._announcing = threading.Lock()
        """Held while announcing: threads of interfaces and of the control client announce; serials go out in order."""
        rules = config.service_rules()
        self._bridge = RosBridge(name=config.node_name, role=config.role, rules=rules)
        self._data_plane = ThreadedDataPlane(
            EngineConfig(config.role, rules, config.budgets()),
            own,
            DataPlaneHooks(
                self._bridge,
                self._on_services_changed,
                self._on_reach_changed,
                self._on_paths_changed,
                self._on_revocations,
                lambda scope: self._control.report_at_once(scope),
                self._on_pong,
            ),
        )
        self._revocations = (
            None
            if tls is None
            else Revocations(
                tls,
                self._data_plane.peer_trust,
                self._store.remember_revocations,
                lambda held: self._control.set_revocations(held),
                config.max_revocation_age,
            )
        )
        last = self._store.last_good
        self._control_session = ControlSession(
            Registration(
                protocol_version=OLDEST_PROTOCOL_VERSION,
                newest_protocol_version=PROTOCOL_VERSION,
                name=config.node_name,
                role=config.role,
                session=own.credential.session,
                token=identity.token,
                incarnation=identity.incarnation,
                software_version=version,
                peers_version=last.peers.version if last.peers else Version(0),
                mapping_version=last.mapping.version if last.mapping else Version(0),
                credential=own.credential.encode(),
                region=config.region or "",
            ),
            random.SystemRandom(),
            last.peers,
        )
        names = config.control_plane
        self._dialer = ControlDialer(
            names,
            self._control_session.stats,
            self._store.control_addresses(names),
            lambda addresses: self._store.remember_addresses(names, addresses),
            self._data_plane.check_paths,
        )
        self._control = ControlClient(self._dialer, self._control_session, self._data_plane, self, self._tls)
        self._interfaces = InterfaceManager(
            config,
            own,
            identity.token,
            self._data_plane,
            self._tell_candidates,
        )
        self._unmet = UnmetServices([rule.pattern for rule in rules], time.monotonic())
        self._metrics: MetricsServer | None = None
        self._mapping_origin: MappingOrigin | None = None
        self._local = self._make_local(version)
        self._untyped: frozenset[ServiceName] = frozenset()
        """Services whose type was missing at the last look."""
        self._logged_mappings: dict[ServiceName, tuple[Assignment, ...]] = {}
        self._version = version

    def start(self) -> None:
        """Start every part; the state from disk is in force before the control plane is contacted.

        Raises:
            OSError: a socket is refused.
        """
        interpreter.share()
        self._open_metrics()
        if self._local is not None:
            try:
                self._local.open()
            except LocalSocketError as error:
                log.warning(
                    "%s: the local socket is missing, so plr doctor sees only the configuration: %s",
                    self._local.path,
                    error,
                )
        self._data_plane.start()
        last = self._store.last_good
        if self._revocations is not None:
            if self._store.revocations:
                self._revocations.take_or_log(self._store.revocations, "an earlier run")
            self._revocations.tell()
            self.look_at_revocations()
        self._interfaces.set_stun_servers(self._stun_servers(last.welcome))
        self._interfaces.start()
        if last.peers is not None:
            self._restore(Apply(ResourceKind.PEERS, last.peers), self._data_plane.apply_peers(last.peers))
        if last.mapping is not None:
            problem = self._data_plane.apply_mapping(last.mapping)
            self._restore(Apply(ResourceKind.MAPPING, last.mapping), problem)
            if problem is None:
                self._mapping_origin = MappingOrigin("disk", time.monotonic())
        self._bridge.start(self._data_plane)
        self._control.start()
        self._control.try_again()  # an interface may have appeared before the mapping was refused for want of it

    def look_at_services(self) -> None:
        """Log once each service that the configuration names but that is not available."""
        stats = self._bridge.stats
        met = {*stats.carried, *stats.left_alone, *stats.missing_types}
        before = self._unmet.unmet, set(self._unmet.unreached), self._untyped
        robot = self._config.role is Role.ROBOT
        unreached = self._data_plane.unreached_services() if robot else {}
        coming = self._data_plane.services_of_peers() if robot else stats.mismatched
        news = self._unmet.look(met, unreached, time.monotonic(), coming)
        self._untyped = frozenset(stats.missing_types)
        if (self._unmet.unmet, set(self._unmet.unreached), self._untyped) != before:
            self._on_services_changed()
        for name in news:
            if servers := self._unmet.unreached.get(name, 0):
                line = told_unreached(name, servers)
            elif name in stats.mismatched:
                line = told_mismatched(name)
            elif robot:
                line = told(name, self._data_plane.services_of_peers(), "no server that this robot knows")
            else:
                line = told(name, stats.carried, "no node of this host's ROS domain")
            log.warning("%s", line)

    def status_line(self) -> str:
        """Return the sidecar's status in a few words, for `systemctl status`."""
        used = self._interfaces.in_use()
        carrying = [name for name, carries in used.items() if carries]
        reached = "reached" if self._control.connected else "not reached"
        services = " ".join(sorted(self._bridge.stats.carried)) or "none"
        problem = self._bridge.stats.not_started
        return (
            (f"{problem}; " if problem else "")
            + f"{len(carrying)} of {len(used)} interfaces in use ({' '.join(sorted(carrying)) or 'none'}), "
            f"control plane {reached}, services offered: {services}"
        )[:MAX_STATUS_CHARACTERS]

    def stop(self) -> None:
        """Finish the requests in flight, say goodbye, end every thread."""
        self._data_plane.drain()
        self._control.drain()
        end = time.monotonic() + DRAIN_S
        while self._data_plane.busy and time.monotonic() < end:
            time.sleep(DRAIN_POLL_S)
        if self._data_plane.busy:
            log.warning("%d requests or messages were still in flight after %.0f s", self._data_plane.busy, DRAIN_S)
        self._bridge.stop()
        self._control.stop()
        self._data_plane.stop()
        self._interfaces.stop()
        self._store.close()
        if self._local is not None:
            self._local.close()
        if self._metrics is not None:
            self._metrics.close()
        interpreter.clear()

    def _make_local(self, version: str) -> LocalSocketServer | None:
        path = self._config.local_socket_path(os.environ.get("RUNTIME_DIRECTORY"))
        if path is None:
            return None
        state = LocalState(
            config=self._config,
            version=version,
            data_plane=self._data_plane,
            interfaces=self._interfaces.views,
            idle=self._interfaces.in_use,
            stun_servers=lambda: self._interfaces.stun_servers,
            unopened=self._interfaces.unopened,
            control=self._control.view,
            bridge=lambda: self._bridge.stats,
            unmet=lambda: self._unmet.unmet,
            unreached=lambda: self._unmet.unreached,
            origin=lambda: self._mapping_origin,
            tls=self._tls,
            clock=self._clock,
            started_at=time.monotonic(),
        )
        return LocalSocketServer(path, state)

    def _open_metrics(self) -> None:
        listen = self._config.metrics_listen
        if listen is None:
            return
        sources = MetricSources(
            name=self._config.name,
            role=self._config.role.value,
            version=self._version,
            engine=lambda: self._data_plane.engine_stats,
            links=self._data_plane.link_stats,
            interfaces=self._interfaces.in_use,
            control=lambda: self._control.stats,
            connected=lambda: self._control.connected,
            bridge=lambda: self._bridge.stats,
            unmet=lambda: self._unmet.unmet,
            state_failures=lambda: self._store.failures,
            certificate=lambda: self._tls.current.identity if self._tls is not None else None,
            files_refused=lambda: self._tls is not None and self._tls.refused is not None,
            revocations=lambda: None if self._revocations is None else self._revocations.state,
            local_refused=lambda: {} if self._local is None else self._local.refused,
        )
        self._metrics = serve_metrics(listen, sources)

    def _restore(self, held: Apply, error: str | None) -> None:
        if error:
            log.warning("the %s kept on disk no longer fits: %s", held.resource.value, error)
            self._control_session.not_restored(held)
        else:
            log.info("started from the %s kept on disk", held.resource.value)

    def _stun_servers(self, welcome: Welcome | None) -> tuple[str, ...]:
        if welcome is not None and welcome.stun_servers:
            return welcome.stun_servers
        hosts = [split_host_port(address)[0] for address in self._config.control_plane]
        shown = [f"[{host}]" if ":" in host else host for host in dict.fromkeys(hosts)]
        return tuple(f"{host}:{DEFAULT_STUN_PORT}" for host in shown)

    def _tell_candidates(self, candidates: tuple[Candidate, ...], down: tuple[InterfaceName, ...]) -> None:
        with self._announcing:
            self._control.set_candidates(self._announcer.announce(candidates, down))
        own: dict[InterfaceName, list[str]] = {}
        for candidate in candidates:
            if candidate.kind is CandidateKind.HOST:
                own.setdefault(candidate.interface, []).append(candidate.address[0])
        self._dialer.set_interfaces(
            [ControlInterface(name, frozenset(addresses), self._config.price(name)) for name, addresses in own.items()]
        )

    def _on_pong(self, pong: Pong) -> None:
        if self._local is not None:
            self._local.on_pong(pong)

    def _on_services_changed(self) -> None:
        offers, uses = self._data_plane.services()
        unmet = map(ServiceName, sorted(self._unmet.unmet)[:MAX_UNMET])
        untyped = sorted(self._untyped)[:MAX_UNMET]
        unreached = map(ServiceName, sorted(self._unmet.unreached)[:MAX_UNMET])
        self._control.set_services(ServiceSet(offers, uses, tuple(unmet), tuple(untyped), tuple(unreached)))

    def _on_reach_changed(self) -> None:
        self._control.try_again()

    def _on_paths_changed(self, best: Mapping[InterfaceName, PathState]) -> None:
        self._dialer.set_paths(best)

    def _on_revocations(self, peer: NodeName, pem: bytes) -> None:
        if self._revocations is not None:
            self._revocations.heard(peer, pem)

    # -- ControlHooks, on the control client's thread -------------------------------------------------------------

    def welcome(self, welcome: Welcome) -> None:
        """Take the welcome of an accepted stream, or a new revocation list of the control plane."""
        if self._revocations is not None and welcome.crl:
            self._revocations.take_or_log(welcome.crl, "the control plane")
        # The list is kept separately, wherever it came from.
        self._store.remember(replace(welcome, crl=b""))
        self._interfaces.set_stun_servers(self._stun_servers(welcome))

    def applied(self, content: PeerSet | MappingSet) -> None:
        """Remember what is in force, and log what a mapping changes."""
        self._store.remember(content)
        if isinstance(content, MappingSet):
            self._mapping_origin = MappingOrigin("control plane", time.monotonic())
            self._log_changes(content)

    def _log_changes(self, mapping: MappingSet) -> None:
        for service in mapping.services:
            if self._logged_mappings.get(service.service) != service.assignments:
                pairs = ", ".join(f"{pair.interface} to {pair.server}" for pair in service.assignments)
                pairs = pairs or "the live paths with the shortest round trips, as it names none"
                log.info("mapping %d: %s goes over %s: %s", mapping.version, service.service, pairs, service.reason)
        self._logged_mappings = {service.service: service.assignments for service in mapping.services}

    def look_at_revocations(self) -> None:
        """Judge the revocation lists that peers sent, and the age of those in use; called every second."""
        if self._revocations is not None and self._tls is not None:
            self._clock.note_lists(self._tls.current.trust)
            self._clock.note(self._tls.current.identity.not_before)
            self._revocations.look(self._clock.now())

    def end_expired(self) -> None:
        """Drop peers whose certificates have expired by now."""
        self._data_plane.peer_trust.end_expired(self._clock.now())

    def judge_again(self) -> None:
        """Judge refused peers again: time has passed or our clock was set, so they may be good now."""
        self._data_plane.peer_trust.judge_again()

    def certificate_changed(self, files: TlsFiles) -> None:
        """Sign this session's credential again with the new certificate files, which are in use now."""
        credential = signed(self._own.credential, files)
        self._data_plane.renew_credential(credential)
        self._control_session.set_credential(credential.encode())
        with self._announcing:
            self._control.set_candidates(self._announcer.again())
        self._data_plane.peer_trust.trust_changed()
        if self._revocations is not None:
            self._revocations.tell()
        log.info("took new certificate files from %s", files.directory)

    def connection_changed(self, connected: bool, reason: str) -> None:
        """Note that the control plane was reached or lost."""
        if not connected:
            log.debug("not connected to the control plane (%s): the last peers and mapping stay in force", reason)


def _open_store(config: SidecarConfig) -> StateStore:
    try:
        return StateStore(config.state_dir, config.node_name)
    except StateDirError as error:
        raise StartError("the configuration", "state_dir", f"{error} ({config.state_dir})") from error


def run(config: SidecarConfig, version: str, stopping: StopRequest) -> int:
    """Run a sidecar until `stopping` is set; return the exit code.

    Raises:
        StartError: the state folder cannot be used now.
    """
    if config.insecure:
        log.warning("insecure: true: the identities of the control plane and of all peers are not checked")
    sidecar = SidecarRuntime(config, version)
    notifier = Notifier()
    sidecar.start()
    interpreter.settle()
    notifier.ready()
    reason = None
    while reason is None:
        notifier.status(sidecar.status_line())
        sidecar.look_at_services()
        reason = stopping.wait(STATUS_EVERY_S)
    log.info("stopping %s: the sidecar takes no new requests and finishes those in flight", reason)
    notifier.stopping()
    sidecar.stop()
    return 0
