"""What a scrape of a simulated world finds."""

from __future__ import annotations

from typing import TYPE_CHECKING

from plr.controlplane.observe.fleet_metrics import MAX_GONE_WITH_SERIES, Fleet
from plr.protos.model.ids import NodeName

if TYPE_CHECKING:
    from collections.abc import Iterable

    from prometheus_client import Metric

    from tests.support.control_world import World

    Series = dict[tuple[str, tuple[tuple[str, str], ...]], float]


def fleet_of(world: World) -> Fleet:
    views = (world.core.view(sidecar.name, world.now) for sidecar in world.core.registry)
    return Fleet(
        members=[view for view in views if view is not None],
        gone=world.core.departed.told(world.now, MAX_GONE_WITH_SERIES),
        certificates_end={NodeName("robot"): 1.8e9},
        now=world.now,
        now_wall=1.7e9,
    )


def series(metrics: Iterable[Metric]) -> Series:
    """The value of each, by its name and its labels."""
    return {
        (sample.name, tuple(sorted(sample.labels.items()))): sample.value
        for metric in metrics
        for sample in metric.samples
    }


def value(found: Series, name: str, **labels: str) -> float | None:
    return found.get((name, tuple(sorted(labels.items()))))
