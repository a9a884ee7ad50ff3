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
    """Name or glob of interfaces. Write each name or glob once."""
    carrier: DomainLabel | None = None
    """Name of the network's operator. The control plane assumes that interfaces with the same carrier fail together."""
    cost_per_request: Annotated[float, Field(ge=0, le=MAX_COST_PER_REQUEST)] = DEFAULT_COST_PER_REQUEST
    """Cost of a copy of a request over this network, in any one currency. It counts for services with `mode: cheapest`.
    The control stream also prefers networks with a lower cost."""
    extra_load: Annotated[float | None, Field(ge=0, le=MAX_EXTRA_LOAD)] = None
    """Budget for the bytes of extra copies over this network, as a share of the bytes of all requests answered in time.
    Each matching interface has its own budget. `0` allows no extra copy. Without this key there is no such limit."""
    extra_mb_per_day: Annotated[float | None, Field(ge=0, le=MAX_EXTRA_MB_PER_DAY)] = None
    """Budget for the bytes of extra copies over this network in 24 hours. The control stream uses a matching interface
    only while no other interface leads to the control plane. Without this key there is no such limit."""

    def budget(self) -> Budget:
        """Return the budget in the form that the cores use."""
        day = self.extra_mb_per_day
        return Budget(self.interface, self.extra_load, None if day is None else int(day * _BYTES_PER_MB))


class ServiceConfig(Section):
    """One service, or all services whose name matches a glob."""

    name: ServicePattern
    """Full name such as `/plan_path`, or a glob such as `/arm/*`. Write each name or glob once. Write a full name
    before a glob that matches it."""
    type: Annotated[ServiceType | None, _ROBOT] = None
    """Type of the service, such as `nav_msgs/srv/GetPlan`. Servers that offer the service with another type get no
    requests. The type must be installed on the robot. Without this key, the type that most servers offer applies."""
    deadline_ms: Annotated[float | None, Field(gt=0, le=MAX_DEADLINE_MS), _ROBOT] = None
    """Required. An answer is in time if it arrives within this many milliseconds. The request does not end at the
    deadline."""
    lifetime_ms: Annotated[float | None, Field(gt=0, le=_MAX_LIFETIME_MS)] = None
    """How long an unanswered request lives.

    On a robot, the sidecar gives up an unanswered request after this time. The value must be above `deadline_ms`. The
    default is 10 deadlines, but at least 30000 (10000 with `drop_late`) and at most 300000. A service without a path or
    a server stays offered for the same time, and for at least 15 s. Then the sidecar withdraws it, and gives up its
    waiting requests.

    On a cloud, the sidecar gives up a local server that does not answer within this time. It notifies the robot, even
    if the robot would wait longer. The default is 60000."""
    idempotent: Annotated[bool, _ROBOT] = False
    """Whether copies of one request may run on several servers.

    - `true`: they may. If only one server was asked and it has the request but is silent at half of the deadline, the
      sidecar asks another server. It does not do this with `redundancy: single`.
    - `false`: one server at a time gets the request, over every interface that reaches this server."""
    drop_late: Annotated[bool, _ROBOT] = False
    """`true`: the sidecar does not deliver an answer after the deadline. The application then gets no answer."""
    fec: RepairShare = "auto"
    """Number of repair symbols for each symbol that this sidecar sends. It applies to requests on a robot, and to
    answers on a cloud. A symbol is the part of a message that one datagram carries. A repair symbol replaces a lost
    symbol without another round trip.

    - `auto`: no repair symbols while no loss is measured. A message of 150 kB gets about 11 % more at 2 % loss, and 17
      % more at 5 % loss. The maximum is 50 % more.
    - `off`: no repair symbols. Lost datagrams are sent again.
    - A number: always this share.

    The sidecar sends some datagrams twice, also with `off`: the last datagram of a message (the only one of a short
    message), and datagrams that are sent again, if they are few. No repair symbol covers these datagrams, and their
    loss would cost another round trip. They are sent twice if the probability that one of them is lost is at least
    0.5 %."""
    priority: Annotated[PriorityWord, converted, _ROBOT] = PriorityWord.NORMAL
    """Requests and answers of a service with a higher priority go before those with a lower one. This holds on the
    robot's paths, on the way back, and in the server's queue. Use `high` for small, urgent requests. Use `low` for bulk
    data that may wait."""
    redundancy: Annotated[RedundancyMode, converted, _ROBOT] = RedundancyMode.REPLICATE
    """Which of the mapped pairs carry a copy of a request. A pair is an interface and a server. The control plane maps
    the pairs of each service.

    - `single`: the best pair.
    - `backup`: the best pair. The next pair follows as soon as the path of the best one is unstable or down, or loses
      the request.
    - `hedge`: the best pair. The next pair follows when the answer takes long. Only for idempotent services.
    - `adaptive`: one pair. Others follow if the first copy makes so little progress that it may miss the deadline. They
      are sent as late as `target_miss` allows. Only for idempotent services.
    - `share`: all mapped interfaces together carry one copy to one server. Each carries as much as it can. Spare
      capacity repeats what other interfaces carry.
    - `replicate`: all pairs at once. `copies` sets how many interfaces are mapped."""
    hedge_quantile: Annotated[float, Field(ge=MIN_HEDGE_QUANTILE, le=MAX_HEDGE_QUANTILE), _ROBOT] = (
        DEFAULT_HEDGE_QUANTILE
    )
    """With `redundancy: hedge` only. The next copy is sent when the answer takes longer than this share of the recent
    answers over the same pair. It is sent at half of the deadline at the latest."""
    repeats: Annotated[float, Field(ge=0, le=1), _ROBOT] = DEFAULT_REPEATS
    """With `redundancy: share` only. Interfaces with spare capacity repeat what other interfaces carry, up to this
    share of the request. With 1, an interface that fails costs no time. With 0, nothing is sent twice. If an interface
    then fails, its part of the request is missing until the sidecar notices the failure."""
    copies: Annotated[CopiesWanted | None, _ROBOT] = None
    """Over how many interfaces the control plane maps copies of a request.

    - `each`: over all interfaces. This is the default.
    - `at_most`: over all interfaces, with exceptions. An interface is left out if its copy would exceed the capacity of
      a server. It is also left out if its copy would go into a region, or behind a carrier, that already has a copy.
      This is the default with `mode: cheapest`.
    - A number: over this many interfaces, the best ones."""
    mode: Annotated[ModeWord, converted, _ROBOT] = ModeWord.MOST_RELIABLE
    """Aim of the mapping.

    - `most_reliable`: to miss as few deadlines as possible.
    - `cheapest`: to cost as little as possible while `target_miss` is kept."""
    target_miss: Annotated[float | None, Field(gt=0, lt=1), _ROBOT] = None
    """The largest predicted probability that a request misses its deadline. The key requires `mode: cheapest` or
    `redundancy: adaptive`.

    - With `mode: cheapest`, the key is required. The control plane takes the cheapest mapping that keeps the target.
    - With `redundancy: adaptive`, the default is 0.001. The sidecar sends further copies early enough to keep the
      target."""
    exploration: Annotated[float, Field(ge=0, le=MAX_EXPLORATION), _ROBOT] = DEFAULT_EXPLORATION
    """The largest share of the requests that get one extra copy to measure a pair of interface and server. The measured
    pair is one that `redundancy` or a budget leaves out, and about which too little is known. For an idempotent
    service, it may also be a pair outside the mapping. A service sends at most 12 such copies a minute. Requests above
    128 KiB and busy interfaces are excluded. `0` turns this off. Only an idempotent service may set another value."""
    fallback: Annotated[FullServiceName | None, _ROBOT] = None
    """Full name of a service that answers when the network does not. A node on this robot serves it, with the same
    type. The first answer wins. The key requires a full name in `name`, and `idempotent: true`. The sidecar never
    carries the fallback service itself, even if a glob matches it."""
    fallback_start: Annotated[FallbackStart, converted, _ROBOT] = FallbackStart.IN_TIME
    """When the sidecar asks the fallback. With both values, it asks at once when the network has refused the request.

    - `in_time`: early enough for an answer by the deadline, and at once while no path is up.
    - `on_miss`: when the network has missed the deadline."""
    fallback_takes_ms: Annotated[float | None, Field(gt=0, le=MAX_DEADLINE_MS), _ROBOT] = None
    """With `fallback_start: in_time` only. The longest time that the fallback takes for a request. It must be less than
    95 % of `deadline_ms`. Without this key, the sidecar measures the time."""
    capacity_interfaces: Annotated[
        int | None, Field(ge=1, le=1_000_000), OnlyOn(Role.CLOUD, "it limits what that server takes")
    ] = None
    """How many interfaces of all robots together the control plane may map to this server for the service. If there is
    no other way, the control plane exceeds the limit and reports it. Without this key, there is no limit."""
    cost_per_request: Annotated[
        float, Field(ge=0, le=MAX_COST_PER_REQUEST), OnlyOn(Role.CLOUD, "a robot's costs are its networks'")
    ] = 0.0
    """Cost of a request that this server runs, in the same currency as the costs of the robots' networks. It counts for
    robots' services with `mode: cheapest`."""

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
