"""Builds one block of the assignment problem from measurements, and its rules from what members declare.

Robots and clouds declare their interfaces' labels, regions, costs and wishes. `problem_builder` decides which blocks
there are and when each is built.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

from plr.controlplane.core.estimate.posterior import Estimate
from plr.controlplane.core.formulation.surplus import most_promising
from plr.controlplane.core.problem.mode_miss import NO_SENDING, Sending, asked_times, is_timed, pair_timing
from plr.controlplane.core.problem.problem import Block, BlockKey, Problem, Target
from plr.protos.model.members import InterfaceLabel

if TYPE_CHECKING:
    from collections.abc import Generator, Iterable, Mapping

    from plr.controlplane.core.estimate.estimator import Estimator
    from plr.controlplane.core.problem.mode_miss import PairTiming
    from plr.controlplane.core.problem.problem import PairIndex
    from plr.controlplane.core.registry.registry import Sidecar
    from plr.protos.model.ids import InterfaceName, NodeName, ServiceName
    from plr.protos.model.members import ServiceUse


def with_rules(block: Block, robot: Sidecar, use: ServiceUse, clouds: Iterable[Sidecar]) -> Block:
    """Return the block with its labels and wishes; `clouds` include at least those of its servers."""
    said = {label.interface: label for label in robot.labels}
    labels = [said.get(interface) or InterfaceLabel(interface) for interface in block.interfaces]
    by_name = {cloud.name: cloud for cloud in clouds}
    servers = [by_name[server] for server in block.servers]
    return replace(
        block,
        copies=use.copies,
        regions=_if_any([cloud.registration.region for cloud in servers]),
        carriers=_if_any([label.carrier for label in labels]),
        target=_target(use, labels, servers) if use.target_miss else None,
    )


def _if_any(labels: list[str]) -> tuple[str, ...]:
    return tuple(labels) if any(labels) else ()


def _target(use: ServiceUse, labels: Iterable[InterfaceLabel], servers: Iterable[Sidecar]) -> Target:
    of_servers = [_charge_of(cloud, use.name) for cloud in servers]
    return Target(
        use.target_miss,
        tuple(tuple(label.cost_per_request + of_server for of_server in of_servers) for label in labels),
    )


def _charge_of(cloud: Sidecar, service: ServiceName) -> float:
    return next((offer.cost_per_request for offer in cloud.offers if offer.name == service), 0.0)


KEPT_PAIRS = 8
"""Pairs with kept estimates that take as long as estimating one."""


@dataclass(frozen=True, slots=True)
class BlockNotes:
    """What the mapping of a block reports besides its plan."""

    servers: tuple[NodeName, ...] = ()
    """All live servers of the service, including those without a path that is up."""
    dark: tuple[InterfaceName, ...] = ()
    """Interfaces left out of the problem, as no path over them is up."""
    all_dark: bool = False
    """Whether no path at all is up, so that every pair was let in."""
    barred: frozenset[tuple[InterfaceName, NodeName]] = frozenset()
    """Pairs that the operator's path rules keep out of mappings."""
    surplus: tuple[InterfaceName, ...] = ()
    """Interfaces left out of the problem, as there are enough more promising ones."""
    penalised: tuple[NodeName, ...] = ()
    """Servers left out of the problem, as the robot cannot use their answers and there are others."""
    unserved: str = ""
    """Why there is nothing to assign; the problem then has no such block."""
    sending: Sending = field(default=NO_SENDING, compare=False)
    """How copies are sent if not all at once; used for the prediction alone."""


@dataclass(frozen=True, slots=True)
class Picture:
    """The present problem, and notes on every use of every robot."""

    problem: Problem
    notes: Mapping[BlockKey, BlockNotes] = field(default_factory=dict)


def interfaces_of(sidecar: Sidecar) -> tuple[InterfaceName, ...]:
    """Return its interfaces, in the order of their first candidate."""
    return tuple(dict.fromkeys(candidate.interface for candidate in sidecar.candidates or ()))


def draw_block(
    robot: Sidecar,
    use: ServiceUse,
    interfaces: tuple[InterfaceName, ...],
    clouds: tuple[Sidecar, ...],
    estimator: Estimator,
    now: float,
    *,
    capacity: int,
    barred: frozenset[tuple[InterfaceName, NodeName]] = frozenset(),
    known: tuple[Block, BlockNotes] | None = None,
    before: Block | None = None,
) -> Generator[float, None, tuple[Block, BlockNotes]]:
    """Draw one robot's use of a service on these clouds, at least one, over these interfaces.

    Only paths that are up are candidates, or all if none is up. `barred` pairs never are; they must not be all pairs.
    Paths to servers that the robot penalises are candidates only if there are no others. What is in `known` is not
    estimated again. Of many interfaces the most promising are taken, with a preference for those taken `before`.

    Yield from time to time the number of pairs estimated since, or of pairs that would have taken that long.
    """
    servers = tuple(cloud.name for cloud in clouds)
    allowed = {(interface, server) for interface in interfaces for server in servers} - barred
    up = {(interface, server) for interface, server in allowed if estimator.path_up(robot.name, interface, server)}
    all_dark = not up
    if all_dark:
        up = allowed
    usable, reaching = ({interface for interface, _ in pairs} for pairs in (allowed, up))
    dark = tuple(interface for interface in interfaces if interface in usable and interface not in reaching)
    penalties = estimator.penalties(robot.name, now)
    favoured = {(interface, server) for interface, server in up if server not in penalties}
    penalised = tuple(server for server in servers if favoured and server in penalties)
    up = favoured or up
    lit = tuple(interface for interface in interfaces if any((interface, server) in up for server in servers))
    kept = _estimates(known[0]) if known is not None else {}
    estimates: dict[tuple[InterfaceName, NodeName], Estimate] = {}
    for interface in lit:
        took = 0.0
        for server in servers:
            pair = interface, server
            if pair in kept and pair in up:
                estimates[pair] = kept[pair]
                took += 1 / KEPT_PAIRS
            elif pair in up:
                estimates[pair] = estimator.estimate(robot.name, interface, server, use.name, use.deadline_s, now)
                took += 1
        yield took
    taken = most_promising(robot, use, lit, estimates, before)
    reached = tuple(server for server in servers if any((interface, server) in up for interface in taken))
    table = [[estimates.get((interface, server)) for server in reached] for interface in taken]
    epsilons = tuple(tuple(found.mean if found else None for found in row) for row in table)
    block = Block(
        key=BlockKey(robot.name, use.name),
        interfaces=taken,
        servers=reached,
        epsilon=epsilons,
        capacity=capacity,
        idempotent=use.idempotent,
        lifts=_lifts(BlockKey(robot.name, use.name), taken, reached, epsilons, estimator, now),
        weights=tuple(tuple(found.weight if found else 0.0 for found in row) for row in table),
    )
    sending = NO_SENDING
    if is_timed(use):
        past = known[1].sending if known is not None else NO_SENDING
        timings: dict[tuple[InterfaceName, NodeName], PairTiming] = {}
        for row in range(len(taken)):
            timings |= _timings(block, row, use, estimator, now, past.timings)
            yield len(reached) / 2
        sending = Sending(timings, *estimator.late_fate(robot.name, use.name, now))
    surplus = tuple(interface for interface in lit if interface not in taken)
    notes = BlockNotes(servers, dark, all_dark, barred, surplus, penalised, sending=sending)
    return with_rules(block, robot, use, clouds), notes


def _timings(
    block: Block,
    interface_number: int,
    use: ServiceUse,
    estimator: Estimator,
    now: float,
    before: Mapping[tuple[InterfaceName, NodeName], PairTiming],
) -> dict[tuple[InterfaceName, NodeName], PairTiming]:
    """Return the timings of one interface's pairs; what is known from `before` is not computed again."""
    times = asked_times(use.deadline_s)
    timings: dict[tuple[InterfaceName, NodeName], PairTiming] = {}
    interface = block.interfaces[interface_number]
    for server, epsilon in zip(block.servers, block.epsilon[interface_number], strict=True):
        if epsilon is None:
            continue
        if (interface, server) in before:
            timings[interface, server] = before[interface, server]
            continue
        pair = interface, server, use.name
        carried = estimator.carried(block.key.robot, pair, now)
        late = use.redundancy.sends_late and not use.budgeted
        slower = estimator.slower_than(block.key.robot, pair, times, now) if late else None
        timings[interface, server] = pair_timing(carried, epsilon, slower, use.hedge_quantile)
    return timings


def _estimates(block: Block) -> dict[tuple[InterfaceName, NodeName], Estimate]:
    return {
        (interface, server): Estimate.of(mean, weight)
        for interface, means, weights in zip(block.interfaces, block.epsilon, block.weights, strict=True)
        for server, mean, weight in zip(block.servers, means, weights, strict=True)
        if mean is not None
    }


def _lifts(
    key: BlockKey,
    interfaces: tuple[InterfaceName, ...],
    servers: tuple[NodeName, ...],
    epsilons: tuple[tuple[float | None, ...], ...],
    estimator: Estimator,
    now: float,
) -> dict[tuple[PairIndex, PairIndex], float]:
    """Return how much more often than by chance two paths over different interfaces miss together, where measured."""
    lifts: dict[tuple[PairIndex, PairIndex], float] = {}
    row = {interface: number for number, interface in enumerate(interfaces)}
    column = {server: number for number, server in enumerate(servers)}
    for first, second in estimator.raced_together(key.robot, key.service):
        if not ({first.interface, second.interface} <= row.keys() and {first.server, second.server} <= column.keys()):
            continue
        one, other = ((row[path.interface], column[path.server]) for path in (first, second))
        epsilon_one, epsilon_other = epsilons[one[0]][one[1]], epsilons[other[0]][other[1]]
        if one[0] == other[0] or epsilon_one is None or epsilon_other is None:
            continue
        product = epsilon_one * epsilon_other
        both_miss = estimator.both_miss(key.robot, key.service, first, second, product, now).mean
        lifts[min(one, other), max(one, other)] = max(1.0, both_miss / product)
    return lifts
