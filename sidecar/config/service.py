"""Defines the sections `services` and `networks` of the sidecar's configuration."""

from __future__ import annotations

import enum
from typing import TYPE_CHECKING, Annotated

from pydantic import Field, model_validator

from plr.protos.convert.fields import MAX_COST_PER_REQUEST
from plr.protos.model.ids import Role, ServiceName
from plr.protos.model.members import AT_MOST_EVERY_INTERFACE, DEFAULT_COST_PER_REQUEST, EVERY_INTERFACE
from plr.protos.model.redundancy_mode import DEFAULT_ADAPTIVE_TARGET, DEFAULT_HEDGE_QUANTILE, RedundancyMode
from plr.protos.program.config_fields import converted
from plr.sidecar.config.fields import (
    CopiesWanted,
    DomainLabel,
    FullServiceName,
    InterfacePattern,
    OnlyOn,
    RepairShare,
    Section,
    ServicePattern,
    ServiceType,
    is_glob,
)
from plr.sidecar.core.base.values import Priority
from plr.sidecar.core.robot.fallback.queue import SPARE
from plr.sidecar.core.rules.budget import Budget
from plr.sidecar.core.rules.service_rule import DEFAULT_REPEATS, MAX_LIFETIME_S, FallbackRule, ServiceRule

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


_ROBOT = OnlyOn(Role.ROBOT, "it is the robot's sidecar that decides this")


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
    """The network behind interfaces."""

    interface: InterfacePattern
    """Name or glob of interfaces. Each is written once."""
    carrier: DomainLabel | None = None
    """Name of the network's operator. Interfaces with the same carrier are assumed to fail together."""
    cost_per_request: Annotated[float, Field(ge=0, le=MAX_COST_PER_REQUEST)] = DEFAULT_COST_PER_REQUEST
    """Cost of a copy of a request over it, in any one currency. It counts for services with `mode: cheapest`. The
    control stream prefers what costs less, too."""
    extra_load: Annotated[float | None, Field(ge=0, le=MAX_EXTRA_LOAD)] = None
    """Extra copies over it may weigh this share of all requests answered in time. Each interface that the name matches
    has a budget of its own. `0` allows no extra copy. Without this key there is no such limit."""
    extra_mb_per_day: Annotated[float | None, Field(ge=0, le=MAX_EXTRA_MB_PER_DAY)] = None
    """Extra copies over it may weigh this much in 24 hours. The control stream takes such an interface only while no
    other leads to the control plane. Without this key there is no such limit."""

    def budget(self) -> Budget:
        """Return the budget in the form that the cores use."""
        day = self.extra_mb_per_day
        return Budget(self.interface, self.extra_load, None if day is None else int(day * _BYTES_PER_MB))


class ServiceConfig(Section):
    """One service, or all services whose name matches a glob."""

    name: ServicePattern
    """Full name such as `/plan_path`, or a glob such as `/arm/*`. Each name is written once. A full name comes before a
    glob that matches it."""
    type: Annotated[ServiceType | None, _ROBOT] = None
    """Type of the service, such as `nav_msgs/srv/GetPlan`. Servers that offer the service with another type get no
    requests, however many they are. Without this key the type of most servers counts."""
    deadline_ms: Annotated[float | None, Field(gt=0, le=MAX_DEADLINE_MS), _ROBOT] = None
    """Required. An answer is in time within this many milliseconds. Nothing ends at the deadline."""
    lifetime_ms: Annotated[float | None, Field(gt=0, le=_MAX_LIFETIME_MS)] = None
    """How long an unanswered request lives.

    Robot: an unanswered request is given up after this time, which is longer than `deadline_ms`. The default is 10
    deadlines, at least 30000 (10000 with `drop_late`) and at most 300000. A service without a path or a server stays
    offered for the same time, 15 s at least. Then it is withdrawn, and waiting requests are given up.

    Cloud: a local server that does not answer is given up after this time, and the robot is notified, even if the robot
    would wait longer. The default is 60000."""
    idempotent: Annotated[bool, _ROBOT] = False
    """Whether copies of one request may run on several servers.

    - `true`: they may. If only one server was asked, has the request and is silent at half the deadline, another server
      is asked (not with `redundancy: single`).
    - `false`: one server at a time gets the request, over every interface that reaches it."""
    drop_late: Annotated[bool, _ROBOT] = False
    """`true`: an answer after the deadline is not delivered, so the application gets none."""
    fec: RepairShare = "auto"
    """Repair symbols for each symbol sent from here (robot: requests, cloud: answers). With them, lost datagrams cost
    no round trip.

    - `auto` adds nothing while no loss is measured. It adds about 11 % to a message of 150 kB at 2 % loss, 17 % at 5 %,
      and at most half.
    - `off` adds nothing; what is lost is sent again.

    From 0.5 % loss on, some datagrams are sent twice, also with `off`: those that no repair symbol covers and whose
    further loss would cost another round trip. These are a message's last datagram (all of a one-datagram message) and
    the few that are sent again."""
    priority: Annotated[PriorityWord, converted, _ROBOT] = PriorityWord.NORMAL
    """Requests and answers of a service with a higher priority go before those of a lower one: on the robot's paths, on
    the way back and in the server's queue. Use `high` for small and urgent requests, `low` for bulk that may wait."""
    redundancy: Annotated[RedundancyMode, converted, _ROBOT] = RedundancyMode.REPLICATE
    """Which of the mapped pairs of interface and server carry a copy.

    - `single`: the best pair.
    - `backup`: also the next one, as soon as the best one's path is unstable or down, or loses the request.
    - `hedge`: also the next one when the answer takes long; idempotent services only.
    - `adaptive`: others as well, as late as `target_miss` allows given the progress of the first copy; idempotent
      services only.
    - `share`: all mapped interfaces carry one copy together, to one server, each as much as it can; spare capacity
      repeats what the others carry.
    - `replicate`: all at once; `copies` says how many are mapped."""
    hedge_quantile: Annotated[float, Field(ge=MIN_HEDGE_QUANTILE, le=MAX_HEDGE_QUANTILE), _ROBOT] = (
        DEFAULT_HEDGE_QUANTILE
    )
    """With `redundancy: hedge` only. The next copy is sent when the answer takes longer than this share of the recent
    answers over that pair, at half the deadline at the latest."""
    repeats: Annotated[float, Field(ge=0, le=1), _ROBOT] = DEFAULT_REPEATS
    """With `redundancy: share` only. Interfaces with capacity to spare repeat up to this share of a request that others
    carry. With 1, an interface that goes dark costs no time. With 0, nothing travels twice, and what such an interface
    carried is missing until that is noticed."""
    copies: Annotated[CopiesWanted | None, _ROBOT] = None
    """Over how many interfaces the control plane maps copies of a request.

    - `each`: over all. This is the default.
    - `at_most`: over all, but over none rather than one too many for a server, or one into a region or behind a carrier
      that has one already. This is the default with `mode: cheapest`.
    - A number: over that many, the best ones."""
    mode: Annotated[ModeWord, converted, _ROBOT] = ModeWord.MOST_RELIABLE
    """Aim of the mapping.

    - `most_reliable`: to miss as few deadlines as possible.
    - `cheapest`: to cost as little as possible while `target_miss` is kept."""
    target_miss: Annotated[float | None, Field(gt=0, lt=1), _ROBOT] = None
    """The largest predicted probability that a request misses its deadline. The key needs `mode: cheapest` or
    `redundancy: adaptive`.

    - With `mode: cheapest` the mapping keeps it. The key is required.
    - With `redundancy: adaptive` the moment at which further copies are sent keeps it. The default is 0.001."""
    exploration: Annotated[float, Field(ge=0, le=MAX_EXPLORATION), _ROBOT] = DEFAULT_EXPLORATION
    """At most this share of the requests gets one more copy, over a pair of interface and server about which too little
    is known: `redundancy` or a budget leaves that pair out, or (idempotent services) the mapping does not use it. There
    are at most 12 such copies a minute, none of requests beyond 128 KiB or over a busy interface. `0` turns this off;
    only idempotent services may set another value."""
    fallback: Annotated[FullServiceName | None, _ROBOT] = None
    """Full name of a service of the same type, served by a node on this robot, that answers when the network does not.
    The first answer wins. The key needs the full name of one service with `idempotent: true`. A fallback is never
    carried itself, whatever glob matches it."""
    fallback_start: Annotated[FallbackStart, converted, _ROBOT] = FallbackStart.IN_TIME
    """When the fallback is asked. Both values: at once when the network has refused.

    - `in_time`: early enough to answer by the deadline, and at once while no path is up.
    - `on_miss`: when the network has missed the deadline."""
    fallback_takes_ms: Annotated[float | None, Field(gt=0, le=MAX_DEADLINE_MS), _ROBOT] = None
    """With `fallback_start: in_time` only. The longest time that the fallback takes for a request, less than 95 % of
    `deadline_ms`. Without this key the sidecar measures it."""
    capacity_interfaces: Annotated[
        int | None, Field(ge=1, le=1_000_000), OnlyOn(Role.CLOUD, "it limits what that server takes")
    ] = None
    """How many interfaces of all robots together the control plane may map to this server for the service. The limit is
    exceeded, and reported, when there is no other way. Without this key there is none."""
    cost_per_request: Annotated[
        float, Field(ge=0, le=MAX_COST_PER_REQUEST), OnlyOn(Role.CLOUD, "a robot's costs are its networks'")
    ] = 0.0
    """Cost of a request that this server runs, in the currency of the robots' networks. It counts for robots' services
    with `mode: cheapest`."""

    @model_validator(mode="before")
    @classmethod
    def _without_nulls(cls, data: object) -> object:
        # A key with nothing after it is as good as left out.
        return {key: value for key, value in data.items() if value is not None} if isinstance(data, dict) else data

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
            idempotent=self.idempotent,
            type=self.type or "",
            drop_late=self.drop_late,
            priority=Priority[self.priority.name],
            fec=_redundancy(self.fec),
            exploration=self.exploration,
            capacity=self.capacity_interfaces or _UNLIMITED,
            redundancy=self.redundancy,
            hedge_quantile=self.hedge_quantile,
            repeats=self.repeats,
            adaptive_target=self.target_miss or DEFAULT_ADAPTIVE_TARGET,
            copies=self.copies or (AT_MOST_EVERY_INTERFACE if cheapest else EVERY_INTERFACE),
            target_miss=(self.target_miss or 0.0) if cheapest else 0.0,
            wanted_miss=self.target_miss or 0.0,
            cost_per_request=self.cost_per_request,
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
        yield from self.misplaced(role)
        if role is Role.CLOUD:
            return
        if self.mode is ModeWord.CHEAPEST and self.target_miss is None:
            yield "target_miss", "expected a probability beside mode: cheapest, but missing"
        adaptive = self.redundancy is RedundancyMode.ADAPTIVE
        if self.mode is not ModeWord.CHEAPEST and not adaptive and self.target_miss is not None:
            yield "target_miss", "expected only beside mode: cheapest or redundancy: adaptive"
        if self.redundancy.sends_late and not self.idempotent:
            word = self.redundancy.value
            yield "redundancy", f"expected {word} beside idempotent: true only, as copies run on several servers"
        if self.redundancy is not RedundancyMode.HEDGE and "hedge_quantile" in self.model_fields_set:
            yield "hedge_quantile", "expected only beside redundancy: hedge"
        if self.redundancy is not RedundancyMode.SHARE and "repeats" in self.model_fields_set:
            yield "repeats", "expected only beside redundancy: share"
        if "exploration" in self.model_fields_set and self.exploration and not self.idempotent:
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
                if key in self.model_fields_set:
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
            yield "fallback_takes_ms", f"expected less than {most:g}, else it cannot answer by deadline_ms"


def _redundancy(fec: float | str) -> Redundancy:
    if fec == "off":
        return 0.0
    return None if isinstance(fec, str) else fec
