"""Gathers what is known of one member for the metrics, quickly and by reference, so that it can be written down on
another thread while the core goes on. Times are monotonic seconds."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import islice
from typing import TYPE_CHECKING

from plr.controlplane.core.formulation.block import interfaces_of
from plr.controlplane.core.problem.mode_miss import NO_SENDING, predicted_miss
from plr.controlplane.core.problem.problem import BlockKey
from plr.protos.model.ids import Role
from plr.protos.model.status import Fault, SyncState

if TYPE_CHECKING:
    from collections.abc import Callable

    from plr.controlplane.core.estimate.estimator import Estimator
    from plr.controlplane.core.estimate.network import ReportedPath
    from plr.controlplane.core.estimate.reached import Reached
    from plr.controlplane.core.estimate.unanswered import Unanswered
    from plr.controlplane.core.explain.faults import Faults
    from plr.controlplane.core.formulation.block import Picture
    from plr.controlplane.core.problem.plan import Plan
    from plr.controlplane.core.publish.snapshots import Snapshots
    from plr.controlplane.core.registry.registry import Sidecar
    from plr.protos.model.ids import InterfaceName, NodeName, ServiceName
    from plr.protos.model.mapping import ServiceMapping
    from plr.protos.model.members import ServiceUse

MAX_VIEWED = 512
"""Paths, and services, of one robot that are examined."""


@dataclass(frozen=True, slots=True)
class InterfaceView:
    """One interface of a robot."""

    name: InterfaceName
    carrier: str
    """Whose network it uses; its own name if that is unknown."""
    up: bool
    """Whether it carries anything, as the robot says."""
    changes: int = 0
    """How often it, or a path over it, went up or down."""
    faults: frozenset[Fault] = frozenset()
    """What is wrong with it."""


@dataclass(frozen=True, slots=True)
class MissView:
    """How often requests of a robot's service miss the deadline."""

    service: ServiceName
    predicted: float | None
    observed: float | None
    target: float
    """What its configuration wants; 0: as few as possible."""
    requests: int
    """Requests that have ended ..."""
    missed: int
    """... and those of them that missed the deadline or failed."""


@dataclass(frozen=True, slots=True)
class ServedView:
    """One service of a server."""

    service: ServiceName
    up: bool
    """Whether a node beside its sidecar serves it now; otherwise it is missed."""
    unanswered: int
    """Measured requests that it received since its last answer and did not answer."""


@dataclass(frozen=True, slots=True)
class MemberView:
    """One registered sidecar."""

    name: NodeName
    role: Role
    connected: bool
    seen_at: float
    paths: tuple[ReportedPath, ...] = ()
    mapping: tuple[ServiceMapping, ...] = ()
    misses: tuple[MissView, ...] = ()
    interfaces: tuple[InterfaceView, ...] = ()
    paths_of_services: tuple[tuple[ServiceName, int], ...] = ()
    """Number of paths of its requests, for each service that it was offered or cannot have."""
    lost: frozenset[NodeName] = frozenset()
    """Servers that it does not reach but once did."""
    unproven: frozenset[NodeName] = frozenset()
    """Servers that it does not reach, and nobody ever has."""
    doubted: frozenset[NodeName] = frozenset()
    """Servers that it has never reached, and that only one other robot claims to have reached."""
    follows: bool = True
    """Whether it has confirmed the mapping that it was last sent, if there is one."""
    restless: frozenset[NodeName] = frozenset()
    """Servers that its paths go up and down to over several interfaces, while paths to others do not."""
    servers: int = 0
    """How many servers a robot was sent: registered ones on which the policy lets it call something."""
    served: tuple[ServedView, ...] = ()
    """What a server that is not about to leave serves, preceded by what it should serve but does not."""


def view_of(
    sidecar: Sidecar,
    snapshots: Snapshots,
    plan: Plan,
    picture: Picture,
    estimator: Estimator,
    reached: Reached,
    unanswered: Unanswered,
    faults: Faults,
    *,
    is_there: Callable[[NodeName], bool],
    is_offered: Callable[[ServiceName], bool],
    may_offer: Callable[[ServiceName], bool],
    seen_at: float,
    now: float,
) -> MemberView:
    """Examine one member; some 40 us for a robot with 15 paths. `is_there` tells which servers the robot has to do
    with, `is_offered` which services a cloud that it may call offers, `may_offer` which ones the policy lets a cloud
    offer."""
    connected = sidecar.stream is not None
    if sidecar.role is not Role.ROBOT:
        served = _served(sidecar, lambda service: unanswered.row(sidecar.name, service, now), may_offer)
        return MemberView(sidecar.name, sidecar.role, connected, seen_at, served=served)
    mapping, peers = snapshots.mapping, snapshots.peers.sent
    # Whatever a robot reports, it makes no series of interfaces that it has not announced, nor of servers that are
    # gone.
    carriers = dict.fromkeys(interfaces_of(sidecar)[:MAX_VIEWED], "")
    carriers |= {label.interface: label.carrier for label in sidecar.labels if label.interface in carriers}
    carriers_down = {label.interface: label.carrier for label in sidecar.down if label.interface not in carriers}
    wrong: dict[InterfaceName, set[Fault]] = {}
    for one in faults.of(sidecar.name, carriers | carriers_down):
        wrong.setdefault(one.interface, set()).add(one.fault)
    changes = estimator.path_changes(sidecar.name)
    interfaces = [
        InterfaceView(
            name,
            carrier or name,
            up=name in carriers,
            changes=changes.get(name, 0) + faults.link_changes(sidecar.name, name),
            faults=frozenset(wrong.get(name, ())),
        )
        for name, carrier in (carriers | carriers_down).items()
    ]
    servers: dict[NodeName, bool] = {}
    found: list[ReportedPath] = []
    for path in estimator.path_views(sidecar.name):
        there = servers.get(path.server)
        if there is None:
            there = servers[path.server] = is_there(path.server)
        if there and path.interface in carriers:
            found.append(path)
            if len(found) == MAX_VIEWED:
                break
    paths = tuple(found)
    unreached = {path.server for path in paths}.difference([path.server for path in paths if path.up])
    return MemberView(
        name=sidecar.name,
        role=sidecar.role,
        connected=connected,
        seen_at=seen_at,
        paths=paths,
        mapping=(mapping.sent or ())[:MAX_VIEWED],
        misses=tuple(_misses(sidecar.name, use, plan, picture, estimator, now) for use in sidecar.uses[:MAX_VIEWED]),
        interfaces=tuple(interfaces[:MAX_VIEWED]),
        paths_of_services=_paths_of_services(sidecar, mapping.sent, is_offered, any(path.up for path in paths)),
        lost=frozenset(server for server in unreached if reached.by(sidecar.name, server)),
        unproven=frozenset(server for server in unreached if not reached.witnesses(server)),
        doubted=frozenset(
            server for server in unreached if reached.witnesses(server) == 1 and not reached.by(sidecar.name, server)
        ),
        restless=faults.restless_servers(sidecar.name) & servers.keys(),
        follows=mapping.state not in (SyncState.STALE, SyncState.REJECTED),
        servers=len(peers.peers) if peers is not None else 0,
    )


def _served(
    cloud: Sidecar, unanswered: Callable[[ServiceName], int], may_offer: Callable[[ServiceName], bool]
) -> tuple[ServedView, ...]:
    if cloud.draining:
        return ()
    offered = [offer.name for offer in cloud.offers]
    # A service that it claims both to offer and to lack makes one series.
    missed = {*cloud.unmet, *cloud.withdrawn}.difference(offered)
    found = [ServedView(name, False, 0) for name in sorted(missed) if may_offer(name)]
    found += (ServedView(name, True, unanswered(name)) for name in offered if may_offer(name))
    return tuple(found[:MAX_VIEWED])


def _paths_of_services(
    sidecar: Sidecar, sent: tuple[ServiceMapping, ...] | None, is_offered: Callable[[ServiceName], bool], reaches: bool
) -> tuple[tuple[ServiceName, int], ...]:
    """Return what the robot carries, as last told, if it was told; and what it wants and nobody serves.

    The latter holds if it says so, if it carried that until no cloud that it may call offered it, or if it says that it
    reaches none of those who serve it, and `reaches` others.
    """
    told = {mapping.service: len(mapping.assignments) for mapping in sent or ()}
    carries = [use.name for use in sidecar.uses]
    found = {name: told[name] for name in carries[:MAX_VIEWED] if name in told}
    given_up = sorted(name for name in sidecar.carried.difference(carries) if not is_offered(name))
    # A robot that reaches no server at all has a trouble of its own.
    unreached = sidecar.unreached if reaches else ()
    lacks = {name: 0 for name in (*sidecar.unmet, *unreached, *given_up) if name not in found}
    return tuple(islice((found | lacks).items(), MAX_VIEWED))


def _misses(
    robot: NodeName, use: ServiceUse, plan: Plan, picture: Picture, estimator: Estimator, now: float
) -> MissView:
    key = BlockKey(robot, use.name)
    block, notes = plan.blocks.get(key), picture.notes.get(key)
    sending = notes.sending if notes is not None else NO_SENDING
    predicted = predicted_miss(use, block, sending) if block is not None else None
    return MissView(
        use.name,
        predicted,
        estimator.observed_miss_ratio(robot, use.name, now),
        use.wanted_miss or use.target_miss,
        *estimator.counted(robot, use.name),
    )
