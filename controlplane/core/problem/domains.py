"""Counts violations of failure domains: copies of a request should not share a region or a carrier.

A choice is charged for each copy that enters a region, or a carrier's network, where there already is one. Interfaces
and servers without a label share nothing. A copy that shares its server beyond the block's capacity counts as that
alone, not also as sharing the region. If every interface carries a copy, the carriers do not depend on the choice and
are not counted; a service that is not idempotent has one server, and so one region.
"""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING

import numpy as np

from plr.controlplane.core.problem.problem import crowding

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from numpy.typing import NDArray

    from plr.controlplane.core.problem.problem import Block, Choice

    Indices = NDArray[np.intp]


def shared_domains(block: Block, choice: Choice) -> tuple[str, ...]:
    """Return the names of the regions and carriers that copies share, whether or not the choice could help it."""
    regions = _labels(block.regions, choice) if block.idempotent else []
    carriers = _labels(block.carriers, [None if server is None else i for i, server in enumerate(choice)])
    return tuple(
        f"{kind} {label}"
        for kind, labels in (("region", regions), ("carrier", carriers))
        for label, count in sorted(Counter(labels).items())
        if count > 1
    )


def violations(block: Block, choice: Choice) -> int:
    """Return how many copies share a domain with an earlier one; with a target, also those that share a server beyond
    the block's own capacity."""
    crowd = crowding(block, choice)
    count = crowd if block.target is not None else 0
    if block.idempotent and block.regions:
        fitting = _within(block, choice) if crowd else choice
        count += _repeats(_labels(block.regions, fitting))
    if chooses_interfaces(block):
        count += _repeats(_labels(block.carriers, [None if server is None else i for i, server in enumerate(choice)]))
    return count


def violation_counts(block: Block, choices: Indices) -> Indices:
    """Return `violations` of many choices, one per row, with -1 where an interface carries no copy."""
    count = np.zeros(len(choices), dtype=np.intp)
    crowd = np.zeros(choices.shape, dtype=np.bool_)
    if block.idempotent and block.capacity:
        crowd = beyond(choices, np.array(block.capacity))
        count += crowd.sum(axis=1) if block.target is not None else 0
    if block.idempotent and block.regions:
        count += repeats(np.where((choices < 0) | crowd, -1, numbered(block.regions)[choices]), np.array(1))
    if block.carriers and chooses_interfaces(block):
        count += repeats(np.where(choices < 0, -1, numbered(block.carriers)), np.array(1))
    return count


def repeats(labels: Indices, free: Indices) -> Indices:
    """Return how many labels of each row have occurred `free` times before; interfaces are the last dimension, and
    values below 0 are no labels."""
    count: Indices = beyond(labels, free).sum(axis=-1)
    return count


def beyond(labels: Indices, free: Indices) -> NDArray[np.bool_]:
    """Return which labels of each row have occurred `free` times before."""
    found = np.zeros(labels.shape, dtype=np.bool_)
    for interface in range(1, labels.shape[-1]):
        label = labels[..., interface]
        before = (labels[..., :interface] == label[..., None]).sum(axis=-1)
        found[..., interface] = (before >= free) & (label >= 0)
    return found


def chooses_interfaces(block: Block) -> bool:
    """Return whether some interface that could carry a copy may go without one."""
    return block.copies_wanted.least < len(block.interfaces)


def least_violations(block: Block) -> int:
    """Return the minimum violations of a choice that crowds no server: as many as copies outnumber domains."""
    if block.target is not None:
        return 0
    least = block.copies_wanted.least
    count = 0
    if block.idempotent and block.regions and all(block.regions):
        count += max(0, least - len(set(block.regions)))
    if block.idempotent and block.carriers and all(block.carriers) and chooses_interfaces(block):
        count += max(0, least - len(set(block.carriers)))
    return count


def has_shared_regions(block: Block) -> bool:
    """Return whether two of its copies may meet in a known region."""
    labels = [region for region in block.regions if region]
    return block.idempotent and (_repeats(labels) > 0 or (bool(labels) and block.capacity != 1))


def _within(block: Block, choice: Choice) -> list[int | None]:
    """Return the choice without the copies beyond the block's own capacity."""
    kept: list[int | None] = []
    for server in choice:
        kept.append(None if kept.count(server) >= block.capacity else server)
    return kept


def _labels(labels: Sequence[str], chosen: Iterable[int | None]) -> list[str]:
    return [labels[number] for number in chosen if number is not None and labels[number]] if labels else []


def _repeats(labels: Sequence[str]) -> int:
    return len(labels) - len(set(labels))


def numbered(labels: Sequence[str]) -> Indices:
    """Return labels as numbers, equal ones as the same; -1 for no label."""
    number = {label: position for position, label in enumerate(dict.fromkeys(labels))}
    return np.array([number[label] if label else -1 for label in labels], dtype=np.intp)
