"""Reports drawn at random, as a small fleet might send them: servers that change, paths that go, robots that fall
silent or exaggerate."""

from __future__ import annotations

import random
from typing import TYPE_CHECKING

from plr.protos.base.histogram import Histogram
from plr.protos.model.ids import InterfaceName, NodeName, ServiceName
from plr.protos.model.mapping import Assignment
from plr.protos.model.report import (
    InterfaceJointReport,
    JointReport,
    LatencyReport,
    OutcomeReport,
    PathReport,
    PenaltyReport,
    Report,
)

if TYPE_CHECKING:
    from collections.abc import Iterator

ROBOTS = tuple(NodeName(f"robot-{number}") for number in range(6))
SERVERS = tuple(NodeName(f"cloud-{number}") for number in range(4))
INTERFACES = tuple(InterfaceName(name) for name in ("wlan0", "wwan0", "wwan1"))
SERVICES = tuple(ServiceName(name) for name in ("/plan", "/look"))
DEADLINES_S = {SERVICES[0]: 0.15, SERVICES[1]: 0.4}


def drawn_reports(seed: int, count: int) -> Iterator[tuple[float, NodeName, Report]]:
    """Time, robot and report, one after the other."""
    rng = random.Random(seed)
    now = 5_000.0
    needs_s = dict.fromkeys(SERVERS, 0.02)
    for _ in range(count):
        now += rng.choice((0.05, 0.2, 0.2, 0.5, 2.0)) if rng.random() < 0.99 else 90.0
        if rng.random() < 0.02:
            needs_s[rng.choice(SERVERS)] = rng.choice((0.005, 0.02, 0.1, 0.3))
        yield now, rng.choice(ROBOTS), _report(rng, needs_s)


def _times(rng: random.Random, samples: int, middle_s: float, lost: int = 0) -> Histogram:
    drawn = Histogram()
    drawn.record_many([middle_s * rng.lognormvariate(0.0, 0.4) for _ in range(samples)])
    drawn.record_lost(lost)
    return drawn


def _latency(rng: random.Random, server: NodeName, need_s: float) -> LatencyReport:
    requests = rng.choice((0, 1, 3, 10, 60, 400))
    answered = rng.randint(0, requests)
    return LatencyReport(
        interface=rng.choice(INTERFACES),
        server=server,
        service=rng.choice(SERVICES),
        size_class=rng.choice((0, 1, 1, 4)),
        network=_times(rng, answered, 0.05, lost=rng.choice((0, 0, 0, 2))),
        called_off=_times(rng, rng.choice((0, 0, 4)), 0.1),
        processing=_times(rng, answered, need_s, lost=rng.choice((0, 0, 0, 0, 1))),
        requests=requests,
        missed=rng.randint(0, requests) if rng.random() < 0.3 else 0,
    )


def _report(rng: random.Random, needs_s: dict[NodeName, float]) -> Report:
    near = rng.sample(SERVERS, rng.randint(1, len(SERVERS)))
    service = rng.choice(SERVICES)
    paths = []
    for interface in INTERFACES[: rng.randint(1, 3)]:
        for server in near:
            sent = rng.choice((0, 10, 1_000))
            rtt = _times(rng, rng.choice((0, 1, 5)), 0.04, lost=rng.choice((0, 0, 1)))
            paths.append(PathReport(interface, server, rng.random() < 0.95, rtt, sent, rng.choice((0, 0, 1, 30))))
    (wlan, wwan, _), joints, fates = INTERFACES, [], []
    if rng.random() < 0.4:
        both = rng.randint(0, 5)
        joints.append(JointReport(service, Assignment(wlan, near[0]), Assignment(wwan, near[-1]), 20, both))
        fates.append(InterfaceJointReport(service, wlan, wwan, rng.choice((None, near[0])), 20, both, 8, 2, 1))
    return Report(
        latencies=tuple(_latency(rng, server, needs_s[server]) for server in rng.choices(near, k=rng.randint(0, 4))),
        paths=tuple(paths),
        outcomes=(OutcomeReport(service, ok=rng.randint(0, 50), deadline_missed=rng.randint(0, 3)),),
        joints=tuple(joints),
        interface_joints=tuple(fates),
        penalties=(PenaltyReport(near[0], 4.0),) if rng.random() < 0.1 else (),
    )
