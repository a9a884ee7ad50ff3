"""Exports to Prometheus what the control plane knows of each member: robots behind a NAT cannot be scraped themselves.

A scrape asks the loop, which gathers references in short turns. The scrape's own thread then makes the series one at a
time: tens of thousands of objects at once would start the garbage collector, for which all threads wait. The series
are bounded, and each robot has its share of them.
"""

from __future__ import annotations

import math
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from typing import TYPE_CHECKING, cast

from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, InfoMetricFamily
from prometheus_client.samples import Sample

from plr.protos.model.ids import Role
from plr.protos.model.status import Fault

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from prometheus_client import Metric

    from plr.controlplane.core.explain.fleet_view import MemberView, MissView, ServedView
    from plr.protos.model.fleet_events import DepartedSidecar
    from plr.protos.model.ids import NodeName

MAX_SERIES = 100_000
"""Most series of all members."""

SERIES_OF_MEMBER = 7
"""Most series of a member, present or gone, besides a robot's own and a server's by service: a server has this many."""

MAX_SERIES_OF_SERVICES = 20_000
"""Series of all servers by service, two for each service; servers have equal shares."""

MAX_GONE_WITH_SERIES = 1024
"""Departed members that still have series, the last to go."""

SERIES_OF_INTERFACE = 3 + len(Fault)
"""Series of one interface of a robot, besides those of its paths."""

REUSED_S = 1.0
"""Scrapes within this interval share their values."""


@dataclass(frozen=True, slots=True)
class Fleet:
    """All members at one moment."""

    members: Sequence[MemberView]
    gone: Sequence[DepartedSidecar]
    certificates_end: Mapping[NodeName, float]
    """Expiry of certificates, in seconds since 1970."""
    now: float
    """The moment in the members' monotonic seconds ..."""
    now_wall: float
    """... and in seconds since 1970."""


@dataclass(frozen=True, slots=True)
class _Room:
    """How many series of each kind a robot may have."""

    served: int
    counted: int
    misses: int
    paths: int
    interfaces: int
    mapped: int
    round_trips: int
    left_out: int


Labels = Sequence[str]
Rows = Callable[[], Iterator[tuple[Labels, float]]]


class _Series:
    """The samples of a metric, made lazily as they are read."""

    def __init__(self, name: str, labels: Labels, rows: Rows) -> None:
        self._name = name
        self._labels = labels
        self._rows = rows

    def __iter__(self) -> Iterator[Sample]:
        for values, value in self._rows():
            yield Sample(self._name, dict(zip(self._labels, values, strict=True)), value)


class FleetCollector:
    """Collects metrics on the thread of a scrape; `ask` gets the fleet from the loop, and may raise TimeoutError."""

    def __init__(self, ask: Callable[[], Fleet]) -> None:
        self._ask = ask
        self._lock = threading.Lock()
        self._fleet: Fleet | None = None
        self._at = -math.inf

    def collect(self) -> Iterable[Metric]:
        """Return all metrics of all members."""
        with self._lock:
            if time.monotonic() - self._at >= REUSED_S:
                self._fleet = None
                try:
                    self._fleet = self._ask()
                except TimeoutError:
                    # The loop stops, or is hopelessly busy: no values are better than old ones that look new.
                    return ()
                self._at = time.monotonic()
            fleet = self._fleet
        return families(fleet) if fleet is not None else ()


def families(fleet: Fleet) -> Iterable[Metric]:
    """Return all metrics, whose samples are made as they are read."""
    fleet = replace(fleet, gone=fleet.gone[:MAX_GONE_WITH_SERIES])
    robots = [member for member in fleet.members if member.role is Role.ROBOT]
    services = _services(fleet)
    of_services = sum(2 * len(found) for _, found, _ in services)
    free = MAX_SERIES - SERIES_OF_MEMBER * (len(fleet.members) + len(fleet.gone)) - of_services
    share = max(0, free) // max(1, len(robots))
    rooms = [(robot, _room(robot, share)) for robot in robots]
    left_out = sum(room.left_out for _, room in rooms) + sum(2 * more for _, _, more in services)
    return (*_members(fleet), _servers(fleet), *_served(services), *_robots(rooms), _left_out(left_out))


def _services(fleet: Fleet) -> list[tuple[NodeName, Sequence[ServedView], int]]:
    """Return the services of each server that have series, and how many more there are."""
    servers = [member for member in fleet.members if member.role is Role.CLOUD]
    most = MAX_SERIES_OF_SERVICES // 2 // max(1, len(servers))
    return [(server.name, server.served[:most], len(server.served[most:])) for server in servers]


def _room(robot: MemberView, share: int) -> _Room:
    """Divide a robot's share among the kinds of series, the most needed first."""
    wanted = (
        len(robot.paths_of_services),
        2 * len(robot.misses),
        sum((miss.predicted is not None) + (miss.observed is not None) + (miss.target > 0.0) for miss in robot.misses),
        len(robot.paths),
        SERIES_OF_INTERFACE * len(robot.interfaces),
        sum(len(mapping.assignments) for mapping in robot.mapping),
        len(robot.paths),
    )
    given = []
    left = share
    for count in wanted:
        given.append(min(count, left))
        left -= given[-1]
    return _Room(
        served=given[0],
        counted=given[1] // 2,
        misses=given[2],
        paths=given[3],
        interfaces=given[4] // SERIES_OF_INTERFACE,
        mapped=given[5],
        round_trips=given[6],
        left_out=sum(wanted) - sum(given),
    )


def _gauge(name: str, text: str, labels: Labels, rows: Rows) -> Metric:
    return _lazy(GaugeMetricFamily(name, text, labels=labels), name, labels, rows)


def _info(name: str, text: str, labels: Labels, rows: Rows) -> Metric:
    return _lazy(InfoMetricFamily(name, text, labels=labels), f"{name}_info", labels, rows)


def _counter(name: str, text: str, labels: Labels, rows: Rows) -> Metric:
    return _lazy(CounterMetricFamily(name, text, labels=labels), name, labels, rows)


def _lazy(family: Metric, name: str, labels: Labels, rows: Rows) -> Metric:
    # A reader iterates over the samples of a metric once.
    family.samples = cast("list[Sample]", _Series(name, labels, rows))
    return family


def _members(fleet: Fleet) -> Iterator[Metric]:
    # A member cut off by the policy counts as gone, and is still there.
    there = {member.name for member in fleet.members}
    gone = [one for one in fleet.gone if one.name not in there]

    def up() -> Iterator[tuple[Labels, float]]:
        yield from (((member.name, member.role.value), float(member.connected)) for member in fleet.members)
        yield from (((one.name, one.role.value), 0.0) for one in gone)

    def seen() -> Iterator[tuple[Labels, float]]:
        began = fleet.now_wall - fleet.now
        yield from (((member.name, member.role.value), round(began + member.seen_at, 3)) for member in fleet.members)
        yield from (((one.name, one.role.value), round(fleet.now_wall - one.seen_s, 3)) for one in gone)

    def ends() -> Iterator[tuple[Labels, float]]:
        for member in fleet.members:
            if (end := fleet.certificates_end.get(member.name)) is not None:
                yield (member.name, member.role.value), end

    def why() -> Iterator[tuple[Labels, float]]:
        yield from (((one.name, one.role.value, one.why.value), 1.0) for one in fleet.gone)

    def went() -> Iterator[tuple[Labels, float]]:
        yield from (((one.name, one.role.value), round(fleet.now_wall - one.gone_s, 3)) for one in fleet.gone)

    labels = ("sidecar", "role")
    yield _gauge("plr_sidecar_up", "1 while the sidecar's control stream is open.", labels, up)
    text = "When the control plane last heard from the sidecar."
    yield _gauge("plr_sidecar_last_seen_timestamp_seconds", text, labels, seen)
    yield _gauge("plr_sidecar_certificate_expiry_timestamp_seconds", "When its certificate expires.", labels, ends)
    yield _info("plr_sidecar_gone", "Sidecars that are gone, and why.", (*labels, "why"), why)
    yield _gauge("plr_sidecar_gone_timestamp_seconds", "When the sidecar was found to be gone.", labels, went)


def _servers(fleet: Fleet) -> Metric:
    def reach() -> Iterator[tuple[Labels, float]]:
        counts: Counter[tuple[NodeName, str]] = Counter()
        doubted: Counter[NodeName] = Counter()
        for robot in fleet.members:
            reaches = {path.server for path in robot.paths if path.up}
            # A robot that reaches no server has a problem of its own.
            if reaches:
                counts.update((server, "up") for server in reaches)
                counts.update((server, "never") for server in robot.unproven)
                doubted.update(robot.doubted)
                counts.update((server, "lost") for server in robot.lost)
                counts.update((server, "restless") for server in robot.restless)
        # One robot that has reached a server proves nothing against two that doubt it.
        counts.update({(server, "never"): count for server, count in doubted.items() if count > 1})
        for member in fleet.members:
            if member.role is Role.CLOUD:
                for path in ("up", "lost", "never", "restless"):
                    yield (member.name, path), float(counts[member.name, path])

    text = (
        "Robots that reach the server (up), or reach only others: lost if they reached it before, never if none did; "
        "restless: to this server alone, their paths over several interfaces go up and down."
    )
    return _gauge("plr_server_robots", text, ("server", "path"), reach)


def _served(services: Sequence[tuple[NodeName, Sequence[ServedView], int]]) -> Iterator[Metric]:
    def up() -> Iterator[tuple[Labels, float]]:
        yield from (((server, one.service), float(one.up)) for server, found, _ in services for one in found)

    def unanswered() -> Iterator[tuple[Labels, float]]:
        yield from (((server, one.service), float(one.unanswered)) for server, found, _ in services for one in found)

    labels = ("server", "service")
    text = "1 while a ROS node at the server serves it, 0 if it is only configured, or was served before."
    yield _gauge("plr_server_service_up", text, labels, up)
    text = "Consecutive requests, of those that robots measure, that the server received but did not answer."
    yield _gauge("plr_server_service_unanswered", text, labels, unanswered)


def _left_out(series: int) -> Metric:
    def rows() -> Iterator[tuple[Labels, float]]:
        yield (), float(series)

    return _gauge("plr_fleet_series_left_out", "Series of robots and servers left out as beyond their share.", (), rows)


def _robots(rooms: Sequence[tuple[MemberView, _Room]]) -> Iterator[Metric]:
    def misses(pick: Callable[[MissView], float | None], before: Sequence[Callable[[MissView], float | None]]) -> Rows:
        def rows() -> Iterator[tuple[Labels, float]]:
            for robot, room in rooms:
                left = room.misses - sum(of(miss) is not None for of in before for miss in robot.misses)
                found = ((miss.service, value) for miss in robot.misses if (value := pick(miss)) is not None)
                for service, value in islice(found, max(0, left)):
                    yield (robot.name, service), value

        return rows

    def predicted(miss: MissView) -> float | None:
        return miss.predicted

    def observed(miss: MissView) -> float | None:
        return miss.observed

    def target(miss: MissView) -> float | None:
        return miss.target or None

    def served() -> Iterator[tuple[Labels, float]]:
        for robot, room in rooms:
            for name, paths in robot.paths_of_services[: room.served]:
                yield (robot.name, name), float(paths)

    def counted(pick: Callable[[MissView], int]) -> Rows:
        def rows() -> Iterator[tuple[Labels, float]]:
            for robot, room in rooms:
                for miss in robot.misses[: room.counted]:
                    yield (robot.name, miss.service), float(pick(miss))

        return rows

    def up() -> Iterator[tuple[Labels, float]]:
        for robot, room in rooms:
            for path in robot.paths[: room.paths]:
                if path.leads_there:
                    yield (robot.name, path.interface, path.server), float(path.up)

    def interfaces() -> Iterator[tuple[Labels, float]]:
        for robot, room in rooms:
            for interface in robot.interfaces[: room.interfaces]:
                yield (robot.name, interface.name, interface.carrier), 1.0

    def carrying() -> Iterator[tuple[Labels, float]]:
        for robot, room in rooms:
            for interface in robot.interfaces[: room.interfaces]:
                yield (robot.name, interface.name), float(interface.up)

    def changes() -> Iterator[tuple[Labels, float]]:
        for robot, room in rooms:
            for interface in robot.interfaces[: room.interfaces]:
                yield (robot.name, interface.name), float(interface.changes)

    def faults() -> Iterator[tuple[Labels, float]]:
        for robot, room in rooms:
            for interface in robot.interfaces[: room.interfaces]:
                for fault in Fault:
                    yield (robot.name, interface.name, fault.value), float(fault in interface.faults)

    def servers() -> Iterator[tuple[Labels, float]]:
        yield from (((robot.name,), float(robot.servers)) for robot, _ in rooms)

    def follows() -> Iterator[tuple[Labels, float]]:
        yield from (((robot.name,), float(robot.follows)) for robot, _ in rooms)

    def mapped() -> Iterator[tuple[Labels, float]]:
        for robot, room in rooms:
            pairs = ((mapping.service, pair) for mapping in robot.mapping for pair in mapping.assignments)
            for service, pair in islice(pairs, room.mapped):
                yield (robot.name, service, pair.interface, pair.server), 1.0

    def round_trips() -> Iterator[tuple[Labels, float]]:
        for robot, room in rooms:
            for path in robot.paths[: room.round_trips]:
                if not math.isnan(path.round_trip_s):
                    yield (robot.name, path.interface, path.server), path.round_trip_s

    path, service = ("robot", "interface", "server"), ("robot", "service")
    yield _gauge(
        "plr_robot_service_paths",
        "Paths that carry the requests of the robot's service; 0: it wants the service, but none can be answered.",
        service,
        served,
    )
    yield _counter(
        "plr_robot_requests_total",
        "Requests of the robot that have ended, as it reports them.",
        service,
        counted(lambda miss: miss.requests),
    )
    yield _counter(
        "plr_robot_requests_missed_total",
        "Requests of the robot that missed their deadline or failed, as it reports them.",
        service,
        counted(lambda miss: miss.missed),
    )
    yield _gauge(
        "plr_predicted_miss_probability",
        "Predicted probability that a request misses its deadline, in the way its copies are sent.",
        service,
        misses(predicted, ()),
    )
    yield _gauge(
        "plr_observed_miss_ratio",
        "Share of recent requests that missed their deadline or failed.",
        service,
        misses(observed, (predicted,)),
    )
    yield _gauge(
        "plr_target_miss_probability",
        "Highest miss probability that the robot's configuration allows, if it names one.",
        service,
        misses(target, (predicted, observed)),
    )
    yield _gauge("plr_robot_path_up", "1 while the robot's path answers, by its last report.", path, up)
    yield _info(
        "plr_robot_interface",
        "The carrier of the robot's interface from its configuration, or else the interface's own name.",
        ("robot", "interface", "carrier"),
        interfaces,
    )
    yield _gauge(
        "plr_robot_interface_up",
        "1 while the robot's interface carries something, 0 while the robot would use it but it carries nothing.",
        ("robot", "interface"),
        carrying,
    )
    yield _counter(
        "plr_robot_interface_changes_total",
        "Times that the robot's interface, or a path over it, went up or down.",
        ("robot", "interface"),
        changes,
    )
    yield _gauge(
        "plr_robot_interface_fault",
        "1 while the robot's interface is up, but is flapping or useless, which another interface makes up for.",
        ("robot", "interface", "fault"),
        faults,
    )
    yield _gauge(
        "plr_robot_mapping_synced", "1 while the robot has confirmed the mapping sent last.", ("robot",), follows
    )
    yield _gauge("plr_robot_servers", "Servers in what the robot was last sent.", ("robot",), servers)
    yield _info(
        "plr_robot_mapping",
        "Interfaces and servers that requests of the robot's service use.",
        ("robot", "service", "interface", "server"),
        mapped,
    )
    yield _gauge("plr_robot_path_rtt_seconds", "Median round trip of the robot's path.", path, round_trips)
