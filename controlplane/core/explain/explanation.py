"""Explains why a robot's service goes where it goes, from what the control plane decided by: its picture and its plan.

Nothing here decides anything, and no epsilon is estimated again: the explanation is of the mapping in force.
"""

from __future__ import annotations

import difflib
import heapq
from collections.abc import Iterator
from dataclasses import replace
from itertools import islice
from typing import TYPE_CHECKING, Protocol

from plr.controlplane.core.estimate.beta import interval_steps
from plr.controlplane.core.explain import alternatives
from plr.controlplane.core.formulation.block import BlockNotes, interfaces_of
from plr.controlplane.core.problem.mode_miss import miss_of, predicted_miss
from plr.controlplane.core.problem.problem import BlockKey
from plr.protos.model.explanation import Belief, Explanation, JointExplanation, MappingChange, PairExplanation
from plr.protos.model.ids import Role
from plr.protos.model.mapping import Assignment

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterable, Mapping, Sequence

    from plr.controlplane.core.estimate.estimator import Evidence
    from plr.controlplane.core.estimate.posterior import Estimate
    from plr.controlplane.core.estimate.shared_fate import CommonMisses
    from plr.controlplane.core.formulation.block import Picture
    from plr.controlplane.core.policy.permits import Permits
    from plr.controlplane.core.problem.plan import BlockPlan, Plan
    from plr.controlplane.core.problem.problem import Block, Choice
    from plr.controlplane.core.publish.history import History
    from plr.controlplane.core.registry.registry import Registry, Sidecar
    from plr.protos.model.ids import InterfaceName, NodeName, ServiceName
    from plr.protos.model.mapping import ServiceMapping
    from plr.protos.model.members import ServiceUse
    from plr.protos.model.report import PenaltyReport
    from plr.protos.model.status import ResourceStatus

LEVEL = 0.9
"""Probability of the reported intervals."""

MIN_COMMON_REQUESTS = 20.0
"""Requests over two interfaces below which nothing is reported of these."""

MAX_SHOWN_PAIRS = 1024
"""Pairs reported, those in use and then the best ones: what the estimator keeps of one robot."""

MAX_LOST_SHOWN = 3
"""Clouds named whose ROS node of a service is gone."""

MAX_COMPARED_NAMES = 32
"""Names compared in full with one that is unknown, those with the most alike at both ends: to compare two long ones
takes a tenth of a millisecond."""


class UnknownNameError(Exception):
    """There is no such robot, or it has no such service; the text says so in one line and names the nearest."""


class Measured(Protocol):
    """What the estimator knows, or knew of a robot when it left."""

    def path_up(self, robot: NodeName, interface: InterfaceName, server: NodeName) -> bool | None:
        """Return whether a path was up when last reported."""

    def penalties(self, robot: NodeName, now: float) -> Mapping[NodeName, PenaltyReport]:
        """Return the servers that the robot asks only as a last resort."""

    def observed_miss_ratio(self, robot: NodeName, service: ServiceName, now: float) -> float | None:
        """Return the share of the recent requests that missed."""

    def evidence(self, robot: NodeName, path: Assignment, service: ServiceName, now: float) -> Evidence:
        """Return what was measured on a pair."""

    def common_misses(
        self, robot: NodeName, service: ServiceName, now: float
    ) -> Iterator[tuple[InterfaceName, InterfaceName, NodeName | None, CommonMisses]]:
        """Yield the pairs of interfaces that carried copies of the same requests."""


def find(registry: Registry, permits: Permits, robot: NodeName, service: ServiceName) -> tuple[Sidecar, ServiceUse]:
    """Return the robot and its use of the service. Raise UnknownNameError if there is none."""
    sidecar = registry.get(robot)
    if sidecar is None:
        robots = (other.name for other in registry if other.role is Role.ROBOT)
        raise UnknownNameError(f"no robot {robot} is registered{_nearest(robot, robots)}")
    if sidecar.role is not Role.ROBOT:
        raise UnknownNameError(f"{robot} is a cloud: ask about a robot")
    if any(use.name == service for use in sidecar.uses):
        return sidecar, find_use(sidecar, service)
    group = permits.group(robot)
    offered: set[ServiceName] = set()
    lost: list[NodeName] = []
    clouds = 0
    for other in registry:
        if other.role is Role.CLOUD:
            names = {offer.name for offer in other.offers}
            offered |= names
            if service not in other.offered or service not in permits.of(group, other):
                continue
            if service in names:
                clouds += 1
            else:
                lost.append(other.name)
    return sidecar, find_use(sidecar, service, offered, clouds, lost)


def find_use(
    robot: Sidecar,
    service: ServiceName,
    offered: Collection[ServiceName] = (),
    clouds: int = 0,
    lost: Sequence[NodeName] = (),
) -> ServiceUse:
    """Return the robot's use of the service; `offered` is what any cloud offers, `clouds` how many let it call this
    service, and `lost` lists those that would but whose ROS node of it is gone. Raise UnknownNameError if there is
    none."""
    for use in robot.uses:
        if use.name == service:
            return use
    if lost and not clouds:
        where = ", ".join(lost[:MAX_LOST_SHOWN])
        where += f" and {len(lost) - MAX_LOST_SHOWN} more" if len(lost) > MAX_LOST_SHOWN else ""
        raise UnknownNameError(
            f"{robot.name} carries no {service}: the ROS node that served it on {where}"
            " is gone, and no other cloud offers it; the sidecar there runs: start the node again"
        )
    if service in robot.unreached:
        raise UnknownNameError(
            f"{robot.name} carries no {service}: {clouds} clouds offer it, but the robot reaches none of them;"
            f" plr status {robot.name} shows the paths, and plr doctor there says more"
        )
    if service in robot.unmet:
        what = f"{robot.name} is configured to carry {service}, but no cloud that it knows offers it"
        if clouds:
            raise UnknownNameError(f"{what}; {clouds} offer it with another type, or the robot does not know them yet")
        if service in offered:
            raise UnknownNameError(f"{what}; the policy denies it those that do")
        raise UnknownNameError(f"{what}{_nearest(service, offered)}")
    if service in robot.untyped:
        raise UnknownNameError(
            f"{robot.name} cannot carry {service}: its service type is not installed there; plr doctor there names it"
        )
    if service in offered:
        why = "its configuration does not name it, a node there serves it, or it reaches none of them"
        raise UnknownNameError(
            f"{robot.name} carries no service {service}, although clouds that it may call offer it: {why}"
            if clouds
            else f"{robot.name} carries no service {service}: the policy denies it the clouds that offer it"
        )
    known = [use.name for use in robot.uses] or offered
    raise UnknownNameError(f"{robot.name} carries no service {service}{_nearest(service, known)}")


def _nearest(name: str, known: Iterable[str]) -> str:
    known = sorted(known)
    if not known:
        return ": there is none"
    if len(known) > MAX_COMPARED_NAMES:
        known = heapq.nlargest(MAX_COMPARED_NAMES, known, key=lambda other: _alike_at_ends(name, other))
    close = difflib.get_close_matches(name, known, n=1, cutoff=0.0)
    return f"; did you mean {close[0]}?" if close else ""


def _alike_at_ends(first: str, second: str) -> float:
    """Return what `difflib` calls the ratio, or less: for names that differ in one place it is the same."""
    begin = _common_beginning(first, second)
    end = _common_beginning(first[begin:][::-1], second[begin:][::-1])
    return (begin + end) / max(1, len(first) + len(second))


def _common_beginning(first: str, second: str) -> int:
    common, beyond = 0, min(len(first), len(second)) + 1
    while beyond - common > 1:
        length = (common + beyond) // 2
        if first.startswith(second[:length]):
            common = length
        else:
            beyond = length
    return common


Pairs = Iterator[PairExplanation | None]
"""The pairs of an explanation, made as they are read; None after a step that made none."""


def whole(parts: tuple[Explanation, Pairs]) -> Explanation:
    """Return an explanation with all its pairs."""
    head, pairs = parts
    return replace(head, pairs=tuple(pair for pair in pairs if pair is not None))


def explain(
    robot: Sidecar,
    use: ServiceUse,
    *,
    picture: Picture,
    plan: Plan,
    estimator: Measured,
    sent: tuple[ServiceMapping, ...],
    sync: ResourceStatus,
    history: History | None,
    clock: Callable[[], float],
) -> tuple[Explanation, Pairs]:
    """Explain the mapping in force for this use of this robot; `sent` and `sync` are what it was last told.

    Return the explanation without its pairs, and these: a thousand take a quarter of a second, and the caller may do
    other work in between. `clock` returns the present time of each step.
    """
    now = clock()
    key = BlockKey(robot.name, use.name)
    block = next((block for block in picture.problem.blocks if block.key == key), None)
    mapping = next((found for found in sent if found.service == use.name), None)
    planned = plan.blocks.get(key)
    notes = picture.notes.get(key) or BlockNotes()
    interfaces, servers = interfaces_of(robot), _servers(notes, mapping)
    chosen = set(mapping.assignments) if mapping is not None else set()
    shown, left_out = _shown(interfaces, servers, chosen, block)

    def miss(of: Block, choice: Choice) -> float:
        return miss_of(use, of, choice, notes.sending)

    head = Explanation(
        robot=robot.name,
        service=use.name,
        deadline_s=use.deadline_s,
        idempotent=use.idempotent,
        objective=picture.problem.objective.value,
        mapping=mapping,
        sync=sync,
        predicted_miss=predicted_miss(use, planned, notes.sending) if planned is not None else None,
        in_force_s=now - history.since if history is not None else None,
        observed_miss=estimator.observed_miss_ratio(robot.name, use.name, now),
        target_miss=use.target_miss,
        cost_per_request=_cost_per_request(block, planned),
        pairs=(),
        pairs_left_out=left_out,
        joints=_joints(robot.name, use.name, block, estimator, now),
        alternatives=alternatives.of(picture.problem, plan, block, miss) if block is not None else (),
        changes=_changes(history, now),
        redundancy=use.redundancy,
    )
    return head, _pairs(shown, chosen, notes, block, estimator, key, clock)


def _servers(notes: BlockNotes, mapping: ServiceMapping | None) -> tuple[NodeName, ...]:
    # The mapping in force may name a server that is gone since.
    mapped = (path.server for path in mapping.assignments) if mapping is not None else ()
    return tuple(dict.fromkeys((*notes.servers, *mapped)))


def _shown(
    interfaces: tuple[InterfaceName, ...],
    servers: tuple[NodeName, ...],
    chosen: Collection[Assignment],
    block: Block | None,
) -> tuple[list[Assignment], int]:
    """Return the pairs to show, those in use first, then the best ones, and how many others there are.

    There may be a million, most of which are not known to be good or bad.
    """
    row = {interface: number for number, interface in enumerate(interfaces)}
    column = {server: number for number, server in enumerate(servers)}
    means = dict(_means(block))
    ranked = [path for path in {*chosen, *means} if path.interface in row and path.server in column]

    def rank(path: Assignment) -> tuple[bool, float, int, int]:
        return path not in chosen, means.get(path, 2.0), row[path.interface], column[path.server]

    ranked.sort(key=rank)
    first = ranked[:MAX_SHOWN_PAIRS]
    known = set(ranked)
    every = (Assignment(interface, server) for interface in interfaces for server in servers)
    rest = (path for path in every if path not in known)
    shown = [*first, *islice(rest, MAX_SHOWN_PAIRS - len(first))]
    return shown, len(interfaces) * len(servers) - len(shown)


def _means(block: Block | None) -> Iterator[tuple[Assignment, float]]:
    """Yield the pairs of a block whose miss probability is estimated, and that probability."""
    if block is None or not block.weights:
        return
    for interface, row in zip(block.interfaces, block.epsilon, strict=True):
        for server, epsilon in zip(block.servers, row, strict=True):
            if epsilon is not None:
                yield Assignment(interface, server), epsilon


def _pairs(
    paths: list[Assignment],
    chosen: Collection[Assignment],
    notes: BlockNotes,
    block: Block | None,
    estimator: Measured,
    key: BlockKey,
    clock: Callable[[], float],
) -> Pairs:
    estimates = {path: estimate for path in paths if (estimate := _estimate(block, path)) is not None}
    intervals = yield from interval_steps(list(estimates.values()), LEVEL)
    beliefs = {
        path: Belief(estimate.mean, low, high)
        for (path, estimate), (low, high) in zip(estimates.items(), intervals, strict=True)
    }
    for path in paths:
        now = clock()
        penalty = estimator.penalties(key.robot, now).get(path.server)
        evidence = estimator.evidence(key.robot, path, key.service, now)
        yield (
            PairExplanation(
                path=path,
                chosen=path in chosen,
                up=estimator.path_up(key.robot, path.interface, path.server),
                miss=beliefs.get(path),
                requests=evidence.requests,
                probes=evidence.probes,
                rtt=evidence.rtt,
                network=evidence.network,
                compute=evidence.compute,
                carrier=_carrier(block, path.interface),
                region=_region(block, path.server),
                barred=(path.interface, path.server) in notes.barred,
                witnesses=evidence.witnesses,
                busiest_witness=evidence.busiest[0] if evidence.busiest is not None else None,
                busiest_share=evidence.busiest[1] if evidence.busiest is not None else 0.0,
                penalty_s=penalty.left_s if penalty is not None else 0.0,
                bad_answers=penalty.bad_answers if penalty is not None else 0,
            )
        )


def _estimate(block: Block | None, path: Assignment) -> Estimate | None:
    if block is None or path.interface not in block.interfaces or path.server not in block.servers:
        return None
    return block.estimate((block.interfaces.index(path.interface), block.servers.index(path.server)))


def _joints(
    robot: NodeName, service: ServiceName, block: Block | None, estimator: Measured, now: float
) -> tuple[JointExplanation, ...]:
    return tuple(
        JointExplanation(
            first=first,
            second=second,
            server=server,
            requests=found.requests,
            first_missed=found.first_missed,
            second_missed=found.second_missed,
            both_missed=found.both_missed,
            correlation=found.correlation,
            shared=_shared(block, first, second, server),
        )
        for first, second, server, found in estimator.common_misses(robot, service, now)
        if found.requests >= MIN_COMMON_REQUESTS
    )


def _shared(
    block: Block | None, first: InterfaceName, second: InterfaceName, server: NodeName | None
) -> tuple[str, ...]:
    """Return what copies over two interfaces have in common, the narrowest of each end."""
    shared = []
    if (carrier := _carrier(block, first)) and carrier == _carrier(block, second):
        shared.append(f"carrier {carrier}")
    if server is not None:
        shared.append(f"server {server}")
    elif block is not None and len(regions := {_region(block, server) for server in block.servers}) == 1:
        shared += [f"region {region}" for region in regions if region]
    return tuple(shared)


def _carrier(block: Block | None, interface: InterfaceName) -> str:
    if block is None or not block.carriers or interface not in block.interfaces:
        return ""
    return block.carriers[block.interfaces.index(interface)]


def _region(block: Block | None, server: NodeName) -> str:
    if block is None or not block.regions or server not in block.servers:
        return ""
    return block.regions[block.servers.index(server)]


def _cost_per_request(block: Block | None, plan: BlockPlan | None) -> float | None:
    return plan.charge if block is not None and block.target is not None and plan is not None else None


def _changes(history: History | None, now: float) -> tuple[MappingChange, ...]:
    if history is None:
        return ()
    return tuple(MappingChange(max(0.0, now - sent.at), sent.version, sent.mapping) for sent in history.changes)
