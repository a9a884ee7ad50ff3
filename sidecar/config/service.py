"""Defines the sections `services` and `networks` of the sidecar's configuration."""

from __future__ import annotations

import enum
from typing import TYPE_CHECKING, Annotated

from pydantic import Field

from plr.protos.convert.fields import MAX_CHARGE
from plr.protos.model.ids import Role, ServiceName
from plr.protos.model.members import AT_MOST_EVERY_INTERFACE, DEFAULT_CHARGE, EVERY_INTERFACE
from plr.protos.model.redundancy_mode import DEFAULT_ADAPTIVE_TARGET, DEFAULT_HEDGE_QUANTILE, RedundancyMode
from plr.sidecar.config.fields import (
    CopiesWanted,
    DomainLabel,
    FullServiceName,
    InterfacePattern,
    RepairShare,
    Section,
    ServicePattern,
    ServiceType,
    converted,
    is_glob,
)
from plr.sidecar.core.base.values import Priority
from plr.sidecar.core.robot.fallback.queue import SPARE
from plr.sidecar.core.rules.budget import Budget
from plr.sidecar.core.rules.service_rule import MAX_LIFETIME_S, FallbackRule, ServiceRule

if TYPE_CHECKING:
    from collections.abc import Iterator

    from plr.sidecar.core.message.repair import Redundancy

MAX_DEADLINE_MS = 60_000
"""End of the latency histogram: a miss of a longer deadline could not be predicted."""

MIN_DEFAULT_LIFETIME_MS = 30_000.0
"""Minimum default lifetime: a late answer is still useful, and a car is out of most tunnels and dead zones by then."""

MIN_DROPPED_LIFETIME_MS = 10_000.0
"""The same with `drop_late`: a request outlives its deadline only until the fate of its copies is known."""

LIFETIME_PER_DEADLINE = 10.0
"""Default lifetime, in deadlines."""

CLOUD_LIFETIME_MS = 60_000.0
"""How long a cloud sidecar waits for a local server by default."""

MAX_EXPLORATION = 0.1
DEFAULT_EXPLORATION = 0.01
"""Default share; its cost is bounded separately, see `plr.sidecar.core.robot.dispatch.exploration`."""

MIN_HEDGE_QUANTILE, MAX_HEDGE_QUANTILE = 0.5, 0.99
"""Below, most requests would be sent twice, which `replicate` does sooner; above, too few latencies are known."""

MAX_EXTRA_LOAD = 16.0
"""More than a request can have copies."""
MAX_EXTRA_MB_PER_DAY = 1e9

_UNLIMITED = 0
_BYTES_PER_MB = 1_000_000
_MS_PER_S = 1000.0
_MAX_LIFETIME_MS = MAX_LIFETIME_S * _MS_PER_S


_ROBOTS_KEYS = (
    "type",
    "deadline_ms",
    "idempotent",
    "drop_late",
    "priority",
    "exploration",
    "redundancy",
    "hedge_quantile",
    "copies",
    "mode",
    "target_miss",
    "fallback",
    "fallback_start",
    "fallback_takes_ms",
)


class PriorityWord(enum.Enum):
    """Which of a robot's services go first."""

    LOW = "low"
    NORMAL = "normal"
    HIGH = "high"


class ModeWord(enum.Enum):
    """What a service's mapping is chosen for."""

    MOST_RELIABLE = "most_reliable"
    CHEAPEST = "cheapest"


class FallbackStart(enum.Enum):
    """When a service's fallback is asked."""

    IN_TIME = "in_time"
    ON_MISS = "on_miss"


class NetworkConfig(Section):
    """What lies behind interfaces; the first entry that matches an interface's name decides."""

    interface: InterfacePattern
    """Name or glob."""
    carrier: DomainLabel | None = None
    """Whose network it is: interfaces with the same carrier are taken to fail together."""
    cost_per_request: Annotated[float, Field(ge=0, le=MAX_CHARGE)] = DEFAULT_CHARGE
    """What a copy of a request over it costs, in any one currency; for services with mode cheapest."""
    extra_load: Annotated[float, Field(ge=0, le=MAX_EXTRA_LOAD)] | None = None
    """Bytes of extra copies over it for each byte of requests answered in time; none: no limit."""
    extra_mb_per_day: Annotated[float, Field(ge=0, le=MAX_EXTRA_MB_PER_DAY)] | None = None
    """Megabytes (10^6 bytes) of extra copies over it in 24 hours; none: no limit."""

    def budget(self) -> Budget:
        """Return the budget in the form that the cores use."""
        day = self.extra_mb_per_day
        return Budget(self.interface, self.extra_load, None if day is None else int(day * _BYTES_PER_MB))


class ServiceConfig(Section):
    """One service, or all whose name matches a glob; the first entry that matches a name decides."""

    name: ServicePattern
    """Full name such as /plan_path, or a glob such as /arm/*."""
    type: ServiceType | None = None
    """Robot: its type, such as nav_msgs/srv/GetPlan: servers that offer it with another get no requests. Default: the
    type of most servers."""
    deadline_ms: Annotated[float, Field(gt=0, le=MAX_DEADLINE_MS)] | None = None
    """Robot, required: an answer is in time within this many milliseconds."""
    lifetime_ms: Annotated[float, Field(gt=0, le=_MAX_LIFETIME_MS)] | None = None
    """Milliseconds after which an unanswered request is given up; more than deadline_ms.

    Robot: by default 10 deadlines, at least 30000 (10000 with drop_late) and at most 300000. Cloud: how long a local
    server is waited for, by default 60000."""
    idempotent: bool | None = None
    """Robot: copies of one request may run on several servers. Default false."""
    drop_late: bool | None = None
    """Robot: an answer after the deadline is not delivered. Default false."""
    priority: Annotated[PriorityWord | None, converted] = None
    """Robot: low, normal or high; what is higher never waits for what is lower. Default normal."""
    fec: RepairShare | None = None
    """Repair symbols for each symbol of what is sent from here (robot: requests, cloud: answers), 0 to 1, or off, or
    auto: as many as the loss measured on the path asks for. Default auto."""
    redundancy: Annotated[RedundancyMode | None, converted] = None
    """Robot: which of the mapped pairs carry a copy: single (the best), backup (the next one too, when the best is in
    trouble), hedge (the next one too, when the answer takes long), adaptive (further ones, as late as target_miss
    allows) or replicate (all). Default replicate."""
    hedge_quantile: Annotated[float, Field(ge=MIN_HEDGE_QUANTILE, le=MAX_HEDGE_QUANTILE)] | None = None
    """Robot, with redundancy hedge: the next copy is sent when the answer takes longer than this share of the answers
    did. Default 0.95."""
    copies: CopiesWanted | None = None
    """Robot: over how many interfaces copies of a request are sent: each, at_most (each, but rather none than one too
    many for a server or into a failure domain already used), or a number. Default each; with mode cheapest at_most."""
    mode: Annotated[ModeWord | None, converted] = None
    """Robot: most_reliable or cheapest, as long as target_miss is kept. Default most_reliable."""
    target_miss: Annotated[float, Field(gt=0, lt=1)] | None = None
    """Robot, with mode cheapest or redundancy adaptive: the largest predicted probability that a request misses its
    deadline. With mode cheapest required, with redundancy adaptive alone 0.001 by default."""
    exploration: Annotated[float, Field(ge=0, le=MAX_EXPLORATION)] | None = None
    """Robot: share of the requests that may get one more copy over a path that the mapping does not use, to learn how
    good it is; idempotent services only. Default 0.01, at most 0.1."""
    fallback: FullServiceName | None = None
    """Robot: a service of the same type, served by a node on this robot, that answers when the network does not;
    idempotent services only."""
    fallback_start: Annotated[FallbackStart | None, converted] = None
    """Robot, with fallback: in_time (early enough to answer by the deadline) or on_miss (when the network has missed
    the deadline). Default in_time."""
    fallback_takes_ms: Annotated[float, Field(gt=0, le=MAX_DEADLINE_MS)] | None = None
    """Robot, with fallback_start in_time: milliseconds that the fallback takes for a request at most. Default: as
    measured."""
    capacity_interfaces: Annotated[int, Field(ge=1, le=1_000_000)] | None = None
    """Cloud: how many robot interfaces may be mapped to this server for the service; none: no limit."""
    cost_per_request: Annotated[float, Field(ge=0, le=MAX_CHARGE)] | None = None
    """Cloud: what a request costs that runs here, in the currency of the robots' networks. Default 0."""

    def rule(self, role: Role) -> ServiceRule:
        """Return the rule in the form that the cores use."""
        if role is Role.CLOUD:
            lifetime_ms = self.lifetime_ms or CLOUD_LIFETIME_MS
            deadline_ms = lifetime_ms
        else:
            deadline_ms = self.deadline_ms or MAX_DEADLINE_MS
            least_ms = MIN_DROPPED_LIFETIME_MS if self.drop_late else MIN_DEFAULT_LIFETIME_MS
            default_ms = min(max(LIFETIME_PER_DEADLINE * deadline_ms, least_ms), _MAX_LIFETIME_MS)
            lifetime_ms = self.lifetime_ms or default_ms
        cheapest = self.mode is ModeWord.CHEAPEST
        return ServiceRule(
            pattern=self.name,
            deadline_s=deadline_ms / _MS_PER_S,
            lifetime_s=lifetime_ms / _MS_PER_S,
            idempotent=bool(self.idempotent),
            type=self.type or "",
            drop_late=bool(self.drop_late),
            priority=Priority[(self.priority or PriorityWord.NORMAL).name],
            fec=_redundancy(self.fec),
            exploration=DEFAULT_EXPLORATION if self.exploration is None else self.exploration,
            capacity=self.capacity_interfaces or _UNLIMITED,
            redundancy=self.redundancy or RedundancyMode.REPLICATE,
            hedge_quantile=self.hedge_quantile or DEFAULT_HEDGE_QUANTILE,
            adaptive_target=self.target_miss or DEFAULT_ADAPTIVE_TARGET,
            copies=self.copies or (AT_MOST_EVERY_INTERFACE if cheapest else EVERY_INTERFACE),
            target_miss=(self.target_miss or 0.0) if cheapest else 0.0,
            wanted_miss=self.target_miss or 0.0,
            charge=self.cost_per_request or 0.0,
            fallback=self._fallback_rule(),
        )

    def _fallback_rule(self) -> FallbackRule | None:
        if self.fallback is None:
            return None
        takes_s = None if self.fallback_takes_ms is None else self.fallback_takes_ms / _MS_PER_S
        in_time = self.fallback_start is not FallbackStart.ON_MISS
        return FallbackRule(ServiceName(self.fallback), in_time=in_time, takes_s=takes_s)

    def problems(self, role: Role) -> Iterator[tuple[str, str]]:
        """Yield each key that is wrong in this role or beside other keys, and why."""
        if role is Role.CLOUD:
            for key in _ROBOTS_KEYS:
                if getattr(self, key) is not None:
                    yield key, "expected on a robot only: it is the robot's sidecar that decides this"
            return
        if self.capacity_interfaces is not None:
            yield "capacity_interfaces", "expected on a cloud only: it limits what that server takes"
        if self.cost_per_request is not None:
            yield "cost_per_request", "expected on a cloud only: a robot's costs are its networks'"
        if self.mode is ModeWord.CHEAPEST and self.target_miss is None:
            yield "target_miss", "expected a probability beside mode: cheapest, but missing"
        adaptive = self.redundancy is RedundancyMode.ADAPTIVE
        if self.mode is not ModeWord.CHEAPEST and not adaptive and self.target_miss is not None:
            yield "target_miss", "expected only beside mode: cheapest or redundancy: adaptive"
        if self.redundancy is not None and self.redundancy.sends_late and not self.idempotent:
            word = self.redundancy.value
            yield "redundancy", f"expected {word} beside idempotent: true only, as copies run on several servers"
        if self.redundancy is not RedundancyMode.HEDGE and self.hedge_quantile is not None:
            yield "hedge_quantile", "expected only beside redundancy: hedge"
        if self.exploration and not self.idempotent:
            yield "exploration", "expected beside idempotent: true, as copies would run on several servers"
        yield from self._fallback_problems()
        if self.deadline_ms is None:
            yield "deadline_ms", "expected milliseconds, but missing"
        elif self.lifetime_ms is not None and self.lifetime_ms <= self.deadline_ms:
            yield (
                "lifetime_ms",
                f"expected more than deadline_ms ({self.deadline_ms:g}), got {self.lifetime_ms:g}",
            )

    def _fallback_problems(self) -> Iterator[tuple[str, str]]:
        if self.fallback is None:
            for key in ("fallback_start", "fallback_takes_ms"):
                if getattr(self, key) is not None:
                    yield key, "expected only beside fallback"
            return
        if is_glob(self.name):
            yield "fallback", f"expected only beside the full name of one service, not '{self.name}'"
        if self.fallback == self.name:
            yield "fallback", "expected another service than the one that it stands in for"
        if not self.idempotent:
            yield "fallback", "expected beside idempotent: true only, as a request may run in the cloud as well"
        if self.fallback_takes_ms is None or self.deadline_ms is None:
            return
        if self.fallback_start is FallbackStart.ON_MISS:
            yield "fallback_takes_ms", "expected only beside fallback_start: in_time"
        elif self.fallback_takes_ms >= (most := (1 - SPARE) * self.deadline_ms):
            yield "fallback_takes_ms", f"expected less than {most:g}, else it can not answer by deadline_ms"


def _redundancy(fec: float | str | None) -> Redundancy:
    if fec == "off":
        return 0.0
    return None if isinstance(fec, str) else fec
