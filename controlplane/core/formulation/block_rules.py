"""What robots and clouds say of their interfaces, regions, charges and wishes, as rules of a block."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from controlplane.core.problem.problem import Target
from protos.model.members import InterfaceLabel

if TYPE_CHECKING:
    from collections.abc import Iterable

    from controlplane.core.problem.problem import Block
    from controlplane.core.registry.registry import Sidecar
    from protos.model.ids import ServiceName
    from protos.model.members import ServiceUse


def with_rules(block: Block, robot: Sidecar, use: ServiceUse, clouds: Iterable[Sidecar]) -> Block:
    """The block with its labels and wishes; `clouds` are at least those of its servers."""
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
        use.target_miss, tuple(tuple(label.charge + of_server for of_server in of_servers) for label in labels)
    )


def _charge_of(cloud: Sidecar, service: ServiceName) -> float:
    return next((offer.charge for offer in cloud.offers if offer.name == service), 0.0)
