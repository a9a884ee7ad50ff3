"""Measures calls of an unmodified ROS 2 client through two sidecars, beside direct calls, and with a silent path.

Control plane, two clouds and robot are the installed programs, over plain kernel cables. The direct pair of client and
server runs on the robot's host in a ROS domain that no sidecar sees.
"""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any

from bench.dataplane.section import Findings, Plot, Section, table_of
from bench.dataplane.statistics import Calls, Interval, Row, interval, median, median_ratio, ratio
from bench.dataplane.topology import CARRIERS, CLOUDS, ROBOT, SilentCut, cables
from bench.reporting.tables import Table
from lab import Lab
from lab.system import Part, System, read_json

if TYPE_CHECKING:
    from bench.dataplane.section import Context
    from bench.reporting.tables import Figure

DEADLINE_MS = 500.0
DIRECT_DOMAIN = 9
DOMAINS = {"direct": DIRECT_DOMAIN, "proxied": 0}
SIZES = {"1k": (1_000, 50.0), "150k": (150_000, 10.0)}
"""Bytes of the request, and requests a second."""
SECONDS = 6.0
"""Length of each repeat: 180 calls of 150 kB in three."""
QUICK_SECONDS = 2.0
RATE_SECONDS = 3.0
BLACKHOLE_BEFORE_S = 2.0
BLACKHOLE_AFTER_S = 9.0
QUICK_BLACKHOLE_AFTER_S = 2.0
GRACE_S = 12.0


def measure(context: Context) -> Findings:
    """Measure."""
    rows: dict[tuple[str, str], list[Row]] = {}
    pooled: dict[tuple[str, str], list[float]] = {}
    rates: dict[str, float] = {}
    with Lab(cables()) as lab:
        system = System(lab, context.folder)
        try:
            context.say("ROS calls: starting the system")
            _start(system)
            for repeat in range(context.repeats):
                for key, (size, rate_hz) in SIZES.items():
                    for kind, domain in DOMAINS.items():
                        context.say(f"ROS calls: {kind}, {size} bytes, {repeat + 1} of {context.repeats}")
                        seconds = QUICK_SECONDS if context.quick else SECONDS
                        calls = _finish(system, _begin(system, size, rate_hz, seconds, domain), seconds)
                        rows.setdefault((kind, key), []).append(calls.row(f"{kind}, {size // 1000} kB"))
                        pooled.setdefault((kind, key), []).extend(calls.answered_ms())
            for kind, domain in DOMAINS.items():
                context.say(f"ROS calls: {kind}, as many as there can be")
                rates[kind] = _rate(system, domain)
            context.say("ROS calls: a path goes silent")
            calls, cut = _blackhole(system, QUICK_BLACKHOLE_AFTER_S if context.quick else BLACKHOLE_AFTER_S)
        finally:
            system.close()
    after = calls.between(cut).row("proxied, 1 kB, after one of two paths went silent")
    figures: dict[str, Figure] = {f"{kind}_{key}_ms": median(r.p50_ms for r in rows[kind, key]) for kind, key in rows}
    intervals: dict[str, Interval | None] = {}
    for key in SIZES:
        pairs = zip(rows["proxied", key], rows["direct", key], strict=True)
        name, both = f"proxied_over_direct_{key}", (pooled["proxied", key], pooled["direct", key])
        figures[f"{name}_of_repeats"] = median(ratio(one.p50_ms, other.p50_ms) for one, other in pairs)
        figures[name] = median_ratio(*both)
        intervals[name] = interval(median_ratio, *both)
    figures["ros_calls_lost"] = sum(row.lost for repeats in rows.values() for row in repeats)
    figures["ros_requests_per_s"] = rates["proxied"]
    figures["ros_direct_requests_per_s"] = rates["direct"]
    figures["blackhole_ros_lost"] = after.lost
    figures["blackhole_ros_p99_ms"] = after.p99_ms
    figures["blackhole_ros_max_ms"] = after.max_ms
    table = table_of("calls of a ROS 2 client", [*(Row.of_repeats(repeats) for repeats in rows.values()), after])
    lines = {"proxied": calls.line(cut)}
    return Findings(
        figures=figures,
        intervals=intervals,
        tables=[table, Table("calls a second, 1 kB, 16 in flight", ("", "1/s"), tuple(rates.items()))],
        plots=[
            Plot("median ROS call", "", "ms", bars=_bars(rows)),
            Plot("a path goes silent", "seconds after the cut", "latency, ms", lines=lines),
        ],
    )


def _bars(rows: dict[tuple[str, str], list[Row]]) -> dict[str, float | None]:
    return {repeats[0].name: median(row.p50_ms for row in repeats) for repeats in rows.values()}


def _start(system: System) -> None:
    system.start_control_plane()
    for cloud in CLOUDS:
        system.start_node(f"{cloud}.echo", cloud, ["-m", "lab.echo", "serve"])
        system.start_cloud(cloud, [{"name": "/echo"}])
    system.start_node("direct.echo", ROBOT, ["-m", "lab.echo", "serve"], domain=DIRECT_DOMAIN)
    robot = system.start_robot([{"name": "/echo", "deadline_ms": DEADLINE_MS, "idempotent": True}])
    system.wait_for_offer(robot)


def _begin(system: System, size: int, rate_hz: float, seconds: float, domain: int) -> Part:
    out = system.folder / "calls.json"
    out.unlink(missing_ok=True)
    (system.folder / "calls.client.log").unlink(missing_ok=True)
    argv = ["-m", "lab.echo", "call", "--size", str(size), "--rate", str(rate_hz), "--duration", str(seconds)]
    argv += ["--deadline-ms", str(DEADLINE_MS), "--grace-s", str(GRACE_S), "--json", str(out)]
    return system.start_node("calls.client", ROBOT, argv, domain=domain)


def _finish(system: System, client: Part, seconds: float) -> Calls:
    client.process.wait(seconds + GRACE_S + 60)
    requests: list[dict[str, Any]] = read_json(system.folder / "calls.json")["requests"]
    latencies = [None if r["latency_ms"] is None else r["latency_ms"] / 1e3 for r in requests]
    return Calls(tuple(r["sent_s"] for r in requests), tuple(latencies))


def _rate(system: System, domain: int) -> float:
    (system.folder / "rate.client.log").unlink(missing_ok=True)
    argv = ["-m", "bench.dataplane.programs.ros_rate", "--seconds", str(RATE_SECONDS)]
    client = system.start_node("rate.client", ROBOT, argv, domain=domain)
    client.process.wait(60)
    return float(client.log.read_text().splitlines()[-1])


def _blackhole(system: System, after_s: float) -> tuple[Calls, float]:
    """Send 50 requests a second of 1 kB, cut the first carrier in the middle; return them and the time of the cut."""
    seconds = BLACKHOLE_BEFORE_S + after_s
    client = _begin(system, 1_000, 50.0, seconds, DOMAINS["proxied"])
    cut = SilentCut(system.lab)
    needed = int(BLACKHOLE_BEFORE_S)
    system.wait("the client to call", lambda: client.log.read_text().count(" sent ") >= needed)
    moment = time.monotonic()
    cut.cut(CARRIERS[0])
    try:
        return _finish(system, client, seconds), moment
    finally:
        cut.mend()


SECTION = Section("ros_calls", "ROS calls through two sidecars", measure)
