"""Computes the mapping each robot should hold, from who is present and the plan. Pure functions."""

from __future__ import annotations

from typing import TYPE_CHECKING

from plr.controlplane.core.formulation.block import interfaces_of
from plr.controlplane.core.formulation.surplus import MAX_PLANNED
from plr.controlplane.core.problem.mode_miss import predicted_miss
from plr.controlplane.core.problem.problem import BlockKey, Objective
from plr.protos.model.mapping import Assignment, ServiceMapping
from plr.protos.model.members import NO_CALLS

if TYPE_CHECKING:
    from collections.abc import Collection, Mapping

    from plr.controlplane.core.formulation.block import BlockNotes, Picture
    from plr.controlplane.core.problem.plan import BlockPlan, Plan
    from plr.controlplane.core.registry.registry import Sidecar
    from plr.protos.model.ids import InterfaceName, NodeName, ServiceName
    from plr.protos.model.members import CallPermit

PREDICTION_CHANGE = 2.0
"""Factor by which a predicted miss probability alone must differ to be sent: it informs, nothing acts on it."""

LEAST = {
    Objective.SUM: "least sum of miss probabilities",
    Objective.PRODUCT: "least product of miss probabilities",
    Objective.JOINT: "least probability that all copies miss",
}
"""The first words of a reason."""

PREDICTION_FLOOR = 1e-3
"""Below this, predictions count as equal."""


def mapping_of(
    robot: Sidecar,
    servers: Mapping[NodeName, CallPermit],
    plan: Plan,
    picture: Picture,
    previous: tuple[ServiceMapping, ...],
) -> tuple[ServiceMapping, ...]:
    """Return the mapping of a robot, by service, with only its own interfaces and `servers`, for what it may call
    there.

    A use not yet in the picture is left out until the next solving, which is due then.
    """
    interfaces = set(interfaces_of(robot))
    before = {mapping.service: mapping for mapping in previous}
    mappings: list[ServiceMapping] = []
    for use in sorted(robot.uses, key=lambda use: use.name):
        key = BlockKey(robot.name, use.name)
        notes = picture.notes.get(key)
        if notes is None:
            continue
        block = plan.blocks.get(key)
        if block is None:
            mappings.append(ServiceMapping(use.name, (), 1.0, notes.unserved or "no plan yet"))
            continue
        planned = tuple(Assignment(interface, server) for interface, server in block.assignments)
        wanted = len(interfaces) if use.target_miss == 0 else 0
        standby = _standby(planned, notes, before.get(use.name), single=not use.idempotent)
        standby = standby[: max(0, min(use.copies.most or wanted, wanted) - len(planned))]
        kept = tuple(
            assignment for assignment in (*planned, *standby) if _is_allowed(assignment, use.name, interfaces, servers)
        )
        predicted = predicted_miss(use, block, notes.sending) if set(planned) & set(kept) else 1.0
        explore = plan.explore.get(key)
        if explore is not None and (explore in kept or not _is_allowed(explore, use.name, interfaces, servers)):
            explore = None
        reason = _reason(block, notes, plan, picture.problem.objective, standby=bool(standby))
        mappings.append(ServiceMapping(use.name, kept, min(1.0, predicted), reason, explore))
    return tuple(mappings)


def changed_robots(plan: Plan, new_plan: Plan, picture: Picture, new_picture: Picture) -> set[NodeName]:
    """Return the robots whose mappings may differ under another plan and picture, while the members are the same."""
    everything = plan.fleet_excess != new_plan.fleet_excess
    keys = new_picture.notes.keys() | picture.notes.keys()
    return {
        key.robot
        for key in keys
        if everything
        or new_plan.blocks.get(key) is not plan.blocks.get(key)
        or new_plan.explore.get(key) != plan.explore.get(key)
        or not _is_same(picture.notes.get(key), new_picture.notes.get(key))
    }


def _is_same(one: BlockNotes | None, other: BlockNotes | None) -> bool:
    return one is other or one == other


def _is_allowed(
    assignment: Assignment,
    service: ServiceName,
    interfaces: Collection[InterfaceName],
    servers: Mapping[NodeName, CallPermit],
) -> bool:
    return assignment.interface in interfaces and service in servers.get(assignment.server, NO_CALLS)


def _standby(
    planned: tuple[Assignment, ...], notes: BlockNotes, before: ServiceMapping | None, *, single: bool
) -> list[Assignment]:
    """Give each dark interface a server too, so that it serves the moment it comes back, control plane or not.

    It keeps the server it had, or takes one that no other interface has; with `single`, the one of all others.
    """
    if not planned:
        return []
    had: Mapping[InterfaceName, NodeName] = (
        {assignment.interface: assignment.server for assignment in before.assignments} if before else {}
    )
    taken = {assignment.server for assignment in planned}
    standby: list[Assignment] = []
    for interface in notes.dark:
        server = had.get(interface)
        allowed = [
            name for name in notes.servers if (interface, name) not in notes.barred and name not in notes.penalised
        ]
        if single:
            server = planned[0].server
        elif server not in allowed:
            server = next((name for name in allowed if name not in taken), next(iter(allowed), None))
        if server is not None and server in allowed:
            standby.append(Assignment(interface, server))
            taken.add(server)
    return standby


def _reason(block: BlockPlan, notes: BlockNotes, plan: Plan, objective: Objective, *, standby: bool) -> str:
    """Return one short line, without figures that change with every report, as a new reason is a new version in
    time."""
    parts = [block.shortfall or "least cost that meets the target" if block.target_miss else LEAST[objective]]
    if block.why:
        parts.append(block.why)
    if notes.all_dark:
        parts.append("no path is up, so all known pairs were considered")
    if notes.dark:
        standing_by = ": on standby" if standby else ""
        parts.append(f"no path is up over {', '.join(notes.dark)}{standing_by}")
    if notes.surplus:
        parts.append(f"more interfaces than {MAX_PLANNED}: without {', '.join(notes.surplus)}")
    if notes.penalised:
        parts.append(f"answers of {', '.join(notes.penalised)} cannot be delivered: other servers come first")
    if block.shared:
        parts.append(f"copies share {', '.join(block.shared)}")
    if block.excess:
        parts.append(f"too few servers: capacity exceeded by {block.excess}")
    servers = {server for _, server in block.assignments}
    fleet = sum(
        excess
        for key, excess in plan.fleet_excess.items()
        if key.service == block.key.service and key.server in servers
    )
    if fleet:
        parts.append(f"too few servers for all robots: capacity exceeded by {fleet}")
    return "; ".join(parts)


def differs(new: tuple[ServiceMapping, ...], old: tuple[ServiceMapping, ...]) -> bool:
    """Return whether a robot would act differently, or has to know why it cannot act."""
    if len(new) != len(old):
        return True
    return any(
        (a.service, a.assignments, a.explore) != (b.service, b.assignments, b.explore)
        or (not a.assignments and a.reason != b.reason)
        for a, b in zip(new, old, strict=True)
    )


def reads_differently(new: tuple[ServiceMapping, ...], old: tuple[ServiceMapping, ...]) -> bool:
    """Return whether the rest, beside equal assignments, is worth a new version sooner or later."""
    return any(
        a.reason != b.reason or _prediction_differs(a.predicted_miss, b.predicted_miss)
        for a, b in zip(new, old, strict=True)
    )


def _prediction_differs(new: float, old: float) -> bool:
    new, old = max(new, PREDICTION_FLOOR), max(old, PREDICTION_FLOOR)
    return not 1 / PREDICTION_CHANGE <= new / old <= PREDICTION_CHANGE
