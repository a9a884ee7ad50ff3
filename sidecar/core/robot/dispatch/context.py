"""Robot side: bundles what the request table works with."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from plr.sidecar.core.base.slices import Backlog
from plr.sidecar.core.robot.dispatch.penalties import Penalties
from plr.sidecar.core.robot.request.index import RequestIndex

if TYPE_CHECKING:
    from collections.abc import Callable

    from plr.sidecar.core.robot.measure.measurements import Measurements
    from plr.sidecar.core.robot.request.mapping_table import MappingTable
    from plr.sidecar.core.robot.request.service_catalog import Offers
    from plr.sidecar.core.rules.budget import Budget
    from plr.sidecar.core.seam.application import ApplicationEvent
    from plr.sidecar.core.seam.links import LinkCommand
    from plr.sidecar.core.seam.stats import EngineStats
    from plr.sidecar.core.transfer.outbox import Outbox
    from plr.sidecar.core.transfer.routes import Routes


@dataclass(frozen=True, slots=True)
class RequestParts:
    """What the request table works with."""

    offers: Offers
    mapping: MappingTable
    routes: Routes
    outbox: Outbox
    measurements: Measurements
    stats: EngineStats
    emit: Callable[[ApplicationEvent], None]
    command: Callable[[LinkCommand], None]
    budgets: tuple[Budget, ...] = ()
    """Limits on the cost of extra copies."""
    backlog: Backlog = field(default_factory=Backlog)
    in_flight: RequestIndex = field(default_factory=RequestIndex)
    penalties: Penalties = field(default_factory=Penalties)
