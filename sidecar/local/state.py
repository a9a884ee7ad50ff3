"""Describes the state of a running sidecar, in parts for its local socket, for `plr doctor` to judge.

It is built from what the threads leave behind, as metrics are. The engine's lock is held only to copy the few
references of the mapping, the services and the refused peers.
"""

from __future__ import annotations

import math
import os
import platform
import time
from dataclasses import dataclass
from itertools import islice
from typing import TYPE_CHECKING, Any

from plr.protos.model.ids import Role
from plr.protos.program.certificate_term import term_problem
from plr.sidecar.core.base.values import PathState
from plr.sidecar.local.protocol import VERSION
from plr.sidecar.local.ways import ways

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterable, Iterator, Mapping

    from plr.protos.model.ids import InterfaceName, NodeName
    from plr.protos.program.tls_files import TlsWatch
    from plr.protos.trust.clock_floor import ClockFloor
    from plr.sidecar.config.sidecar import SidecarConfig
    from plr.sidecar.control.client import ControlView
    from plr.sidecar.core.base.values import PathId
    from plr.sidecar.core.engine.engine import RemovedPeerView
    from plr.sidecar.core.robot.robot_role import Destinations
    from plr.sidecar.net.dataplane import ThreadedDataPlane
    from plr.sidecar.net.interface_manager import InterfaceView
    from plr.sidecar.ros.stats import BridgeStats

PATHS_A_PART = 16
SERVICES_A_PART = 16
GONE_S, MAX_GONE = 3600.0, 64
"""Time for which paths to nodes that are no longer peers are reported, and most of them. The same holds for peers that
the control plane removed, except that those that are still kept are reported for as long. `removed_counts` counts
those beyond."""
MAX_CONFLICTS = 64
"""Most servers of another type shown."""
MAX_REFUSED_PEERS = 64
"""Most refused peers shown."""
ENVIRONMENT = (
    "ROS_DOMAIN_ID", "ROS_AUTOMATIC_DISCOVERY_RANGE", "ROS_LOCALHOST_ONLY", "ROS_STATIC_PEERS", "ROS_DISTRO",
    "RMW_IMPLEMENTATION", "FASTRTPS_DEFAULT_PROFILES_FILE", "FASTDDS_DEFAULT_PROFILES_FILE", "CYCLONEDDS_URI",
    "AMENT_PREFIX_PATH",
)  # fmt: skip
"""Environment variables reported: those that ROS uses, and no others."""


@dataclass(frozen=True, slots=True)
class MappingOrigin:
    """The origin of the mapping in force."""

    source: str
    """The control plane, or disk."""
    at: float
    """When it was put in force (monotonic, s)."""


@dataclass(frozen=True, slots=True)
class LocalState:
    """Asks the parts of a sidecar; every method may be called from any thread."""

    config: SidecarConfig
    version: str
    data_plane: ThreadedDataPlane
    interfaces: Callable[[], Iterable[InterfaceView]]
    idle: Callable[[], Mapping[InterfaceName, bool]]
    """Return the wanted interfaces, and whether each can carry something."""
    stun_servers: Callable[[], tuple[str, ...]]
    """Return the STUN servers in use, as host and port; empty before the first are known."""
    unopened: Callable[[], Mapping[InterfaceName, str]]
    """Return the interfaces whose sockets could not be opened, and why."""
    control: Callable[[], ControlView]
    bridge: Callable[[], BridgeStats]
    unmet: Callable[[], Iterable[str]]
    unreached: Callable[[], Mapping[str, int]]
    """Return the services with known servers of which none is reached, each with the number of servers."""
    origin: Callable[[], MappingOrigin | None]
    tls: TlsWatch | None
    clock: ClockFloor
    started_at: float
    """When the sidecar started (monotonic, s)."""

    def state(self) -> Iterator[tuple[str, Any]]:
        """Yield the parts of the state; ages are seconds and never negative."""
        now = time.monotonic()
        yield "node", self._node(now)
        yield "clock", {"floor": self.clock.floor}
        if self.tls is not None:
            yield "certificate", self._certificate()
        for view in self.interfaces():
            yield "interfaces", _interface(view, now)
        yield "idle", [name for name, carries in self.idle().items() if not carries]
        yield "unopened", dict(self.unopened())
        yield "control", self._control(now)
        destinations = self.data_plane.destinations() if self.config.role is Role.ROBOT else None
        yield from self._services(now, destinations)
        refused = self.data_plane.peer_trust.refused(MAX_REFUSED_PEERS)
        yield "refused_peers", [{"name": name, "why": why} for name, why in refused]
        heard = self.data_plane.heard_dormant(now)
        removed = self.data_plane.removed_peers(now - GONE_S, MAX_GONE)
        yield "removed_peers", [_removed(one, now, heard) for one in removed]
        yield "removed_counts", self.data_plane.removed_counts(now - GONE_S)._asdict()
        gone = self.data_plane.gone_paths(now - GONE_S, MAX_GONE)
        yield (
            "gone",
            [
                {
                    "interface": path.interface,
                    "peer": path.peer,
                    "since_s": max(0.0, now - last.at),
                    "reason": last.reason,
                }
                for path, last in gone
            ],
        )
        yield from self._paths(now)

    def paths_to(self, peer: str, interface: str | None) -> list[PathId]:
        """Return the paths to a peer; see `LocalSource`."""
        return [path for path in self.data_plane.paths_to(peer) if interface in (None, path.interface)]

    def ping(self, path: PathId, number: int, size: int) -> None:
        """Send a ping; see `LocalSource`."""
        self.data_plane.ping(path, number, size)

    def _node(self, now: float) -> dict[str, Any]:
        config, bridge = self.config, self.bridge()
        return {
            "protocol": VERSION,
            "name": config.name,
            "role": config.role.value,
            "version": self.version,
            "python": platform.python_version(),
            "pid": os.getpid(),
            "user": os.geteuid(),
            "up_s": now - self.started_at,
            "insecure": config.insecure,
            "stun": config.stun.enabled,
            "stun_servers": list(self.stun_servers()),
            "ros_problem": bridge.not_started,
            "left_out_peers": list(bridge.left_out_peers),
            "environment": {name: _told(os.environ[name]) for name in ENVIRONMENT if name in os.environ},
        }

    def _certificate(self) -> dict[str, Any]:
        assert self.tls is not None
        files, judged_at = self.tls.current, self.clock.now()
        problem, refused = term_problem(files, judged_at), self.tls.refused
        lists = [one for one in files.trust.lists().values() if one is not None]
        return {
            "directory": str(files.directory),
            "name": files.identity.name,
            "role": files.identity.role.value,
            "serial": f"{files.identity.serial:x}",
            "not_before": files.identity.not_before,
            "not_after": files.identity.not_after,
            "judged_at": judged_at,
            "problem": None if problem is None else {"in_force": problem.in_force, "text": problem.text},
            "refused": None if refused is None else {"start": refused.start, "text": refused.why},
            "revocation_lists": [{"number": min(one.number, 1 << 53), "signed_at": one.signed_at} for one in lists],
        }

    def _control(self, now: float) -> dict[str, Any]:
        view = self.control()
        return {
            "names": list(view.names),
            "connected": view.connected,
            "since_s": max(0.0, now - view.since),
            "way": view.way,
            "interface": view.interface,
            "last_failure": view.last_failure,
            "retry_in_s": None if view.connected else max(0.0, min(view.retry_at - now, 3600.0)),
        }

    def _services(self, now: float, destinations: Destinations | None) -> Iterator[tuple[str, Any]]:
        bridge = self.bridge()
        offers, uses = self.data_plane.services()
        types = {offer.name: offer.type for offer in offers} | {use.name: use.type for use in uses}
        yield (
            "services",
            {
                "carried": {name: types.get(name, "") for name in sorted(bridge.carried)},
                "left_alone": {name: list(nodes) for name, nodes in bridge.left_alone.items()},
                "missing_types": dict(bridge.missing_types),
                "unmet": sorted(set(self.unmet()) - bridge.mismatched - bridge.silent),
                "mismatched": sorted(bridge.mismatched),
                "silent": sorted(bridge.silent),
                "unreached": dict(self.unreached()),
                "configured": [service.name for service in self.config.services],
                "conflicts": [
                    {"service": service, "server": server, "type": kind}
                    for service, server, kind in sorted(() if destinations is None else destinations.conflicts)
                ][:MAX_CONFLICTS],
            },
        )
        origin = self.origin()
        mapped = self.data_plane.service_mappings
        yield (
            "mapping",
            {
                "version": self.data_plane.engine_stats.mapping_version,
                "source": None if origin is None else origin.source,
                "age_s": None if origin is None else max(0.0, now - origin.at),
            },
        )
        deadlines = {use.name: use.deadline_s for use in uses}
        rows = iter(mapped)
        while part := list(islice(rows, SERVICES_A_PART)):
            yield (
                "mapped",
                [
                    {
                        "service": one.service,
                        "pairs": [{"interface": pair.interface, "server": pair.server} for pair in one.assignments],
                        "predicted_miss": one.predicted_miss if math.isfinite(one.predicted_miss) else None,
                        "reason": one.reason,
                        "deadline_s": deadlines.get(one.service),
                    }
                    for one in part
                ],
            )

        if destinations is None:
            return
        found = ways(destinations, mapped, (view for view, _ in self.data_plane.path_views(now)))
        while some := list(islice(found, SERVICES_A_PART)):
            yield (
                "ways",
                [
                    {
                        "service": one.service,
                        "paths": [{"interface": path.interface, "server": path.peer} for path in one.paths],
                    }
                    for one in some
                ],
            )

    def _paths(self, now: float) -> Iterator[tuple[str, Any]]:
        views = self.data_plane.path_views(now)
        while part := list(islice(views, PATHS_A_PART)):
            yield (
                "paths",
                [
                    {
                        "interface": view.id.interface,
                        "peer": view.id.peer,
                        "remote": view.id.remote,
                        "address": None if view.remote is None else list(view.remote),
                        "candidates": view.candidates,
                        "state": view.state.value,
                        "since_s": None if change is None else max(0.0, now - change.at),
                        "reason": None if change is None else change.reason,
                        "rtt_s": view.smoothed_rtt_s,
                        "sent": view.sent,
                        "lost": max(0, view.lost - view.spurious),
                        "recent": view.recent._asdict(),
                        "max_datagram": view.max_datagram,
                        "proven_s": max(0.0, now - view.proven_at),
                        "rests": view.state is PathState.UP and view.probe_every_s > 1.0,
                    }
                    for view, change in part
                ],
            )


def _removed(peer: RemovedPeerView, now: float, heard: Collection[NodeName] = ()) -> dict[str, Any]:
    reason, dormant_at = peer.removal.reason, peer.removal.dormant_at
    return {
        "name": peer.name,
        "reason": None if reason is None else reason.value,
        "since_s": max(0.0, now - peer.removal.at),
        "kept": peer.kept,
        "dormant_s": max(0.0, now - dormant_at) if peer.kept == "dormant" and dormant_at is not None else None,
        "heard": peer.kept == "dormant" and peer.name in heard,
    }


def _interface(view: InterfaceView, now: float) -> dict[str, Any]:
    return {
        "name": view.name,
        "suspended": view.suspended,
        "addresses": list(view.addresses),
        "port": view.port,
        "mtu": view.mtu,
        "bound_to": view.bound_to,
        "hangs": view.hangs,
        "stun_families": sorted(one.family for one in view.stun),
        "stun": [
            {
                "family": one.family,
                "mapping": None if one.mapping is None else list(one.mapping),
                "server": None if one.server is None else list(one.server),
                "answered_s": None if one.answered_at is None else max(0.0, now - one.answered_at),
                "changes": one.changes,
                "problem": one.problem,
            }
            for one in view.stun
            if one.family in view.families
        ],
    }


def _told(value: str) -> str:
    """Return a variable's value, but not a whole configuration in it, which may hold passwords."""
    return f"{len(value)} characters of configuration" if "<" in value else value
