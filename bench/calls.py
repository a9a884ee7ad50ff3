"""The call through two sidecars beside the direct ROS 2 call, and beside itself with one path silently dead.

One run measures all of it: direct calls on one host, calls through robot's and cloud's sidecars over links without
delay, and the blackhole (50 Hz x 1 kB, one of two carriers swallows everything from one third of the run on, its
interface stays up) beside the same run undisturbed. Ratios and differences are what to quote; the absolute times are
this machine's.
"""

from __future__ import annotations

import json
import tempfile
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.table import Table

from bench.netlab import Lab, LabConfig, LinkProfile
from bench.system import System, read_json
from examples.request_log import quantile

if TYPE_CHECKING:
    import argparse

DEADLINE_MS = 500.0
CLOUDS = ("cloud_a", "cloud_b")
DIRECT_DOMAIN = 9
"""ROS domain of the direct pair, which no sidecar sees."""
BLACKHOLE_LINK = LinkProfile(delay_ms=5)


@dataclass(frozen=True, slots=True)
class Row:
    """One stretch of calls; times in milliseconds, the unanswered counted in `lost` only."""

    name: str
    sent: int
    lost: int
    p50_ms: float
    p99_ms: float
    max_ms: float


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of `python -m bench calls`."""
    parser.add_argument("--seconds", type=float, default=20.0, help="length of each stretch (default %(default)s)")
    parser.add_argument(
        "--out", type=Path, default=Path("bench/results"), help="folder for calls.json (default %(default)s)"
    )


def run(options: argparse.Namespace) -> int:
    """Measure and write calls.json; returns the exit code: 1 when a request was lost."""
    console = Console()
    with (
        tempfile.TemporaryDirectory(prefix="plr-bench-") as folder,
        Lab(LabConfig.of(interfaces=("wlan0", "wwan0"), clouds=len(CLOUDS)), seed=1) as lab,
    ):
        system = System(lab, Path(folder))
        with console.status("starting the system"):
            _start(system)
        rows = {}
        for size, rate in ((1_000, 50.0), (150_000, 10.0)):
            for name, domain in (("direct", DIRECT_DOMAIN), ("proxied", 0)):
                with console.status(f"{name}, {size} bytes, {rate:g} Hz"):
                    calls = _call(system, size, rate, options.seconds, domain)
                rows[f"{name}_{size // 1000}k"] = _row(f"{name}, {size // 1000} kB at {rate:g} Hz", calls)
        for interface in ("wlan0", "wwan0"):
            lab.link(interface).set(BLACKHOLE_LINK)
        for name, dark in (("undisturbed", False), ("blackhole", True)):
            with console.status(f"{name}, 1000 bytes, 50 Hz"):
                calls = _call(system, 1_000, 50.0, options.seconds, 0, blackhole="wlan0" if dark else None)
            rows[name] = _row(f"{name}, 1 kB at 50 Hz, 2 x 5 ms", calls)
        lateness = {name: asdict(lab.link(name).stats().lateness) for name in ("wlan0", "wwan0")}
        system.close()
    figures = {
        "proxied_over_direct_1k": rows["proxied_1k"].p50_ms / rows["direct_1k"].p50_ms,
        "proxied_over_direct_150k": rows["proxied_150k"].p50_ms / rows["direct_150k"].p50_ms,
        "blackhole_lost": rows["blackhole"].lost,
        "blackhole_p99_ms": rows["blackhole"].p99_ms,
        "blackhole_p99_over_undisturbed_ms": rows["blackhole"].p99_ms - rows["undisturbed"].p99_ms,
    }
    _show(console, rows, figures)
    options.out.mkdir(parents=True, exist_ok=True)
    content = {**figures, "rows": {key: asdict(row) for key, row in rows.items()}, "emulator_lateness_s": lateness}
    (options.out / "calls.json").write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
    return 1 if any(row.lost for row in rows.values()) else 0


def _start(system: System) -> None:
    system.start_control_plane()
    for cloud in CLOUDS:
        system.start_node(f"{cloud}.echo", cloud, ["-m", "bench.echo", "serve"])
        system.start_cloud(cloud, [{"name": "/echo"}])
    system.start_node("direct.echo", "robot", ["-m", "bench.echo", "serve"], domain=DIRECT_DOMAIN)
    robot = system.start_robot([{"name": "/echo", "deadline_ms": DEADLINE_MS, "idempotent": True}])
    system.wait_for_offer(robot)


def _call(
    system: System, size: int, rate: float, seconds: float, domain: int, *, blackhole: str | None = None
) -> list[dict[str, Any]]:
    out = system.folder / "calls.json"
    out.unlink(missing_ok=True)
    argv = ["-m", "bench.echo", "call", "--size", str(size), "--rate", str(rate), "--duration", str(seconds)]
    argv += ["--deadline-ms", str(DEADLINE_MS), "--grace-s", "15", "--json", str(out)]
    client = system.start_node("calls.client", "robot", argv, domain=domain)
    client.log.write_text("")
    if blackhole is not None:
        needed = int(seconds / 3)
        system.wait("the client to call", lambda: client.log.read_text().count(" sent ") >= needed, seconds + 60)
        system.lab.link(blackhole).blackhole()
    client.process.wait(seconds + 90)
    if blackhole is not None:
        system.lab.link(blackhole).restore()
    requests: list[dict[str, Any]] = read_json(out)["requests"]
    return requests


def _row(name: str, requests: list[dict[str, Any]]) -> Row:
    latencies = sorted(r["latency_ms"] for r in requests if r["latency_ms"] is not None)
    return Row(
        name,
        sent=len(requests),
        lost=len(requests) - len(latencies),
        p50_ms=quantile(latencies, 0.5) or 0.0,
        p99_ms=quantile(latencies, 0.99) or 0.0,
        max_ms=latencies[-1] if latencies else 0.0,
    )


def _show(console: Console, rows: dict[str, Row], figures: dict[str, float]) -> None:
    table = Table(title="service calls from an unmodified client")
    for column in ("", "requests", "lost", "P50 ms", "P99 ms", "worst ms"):
        table.add_column(column, justify="right" if column else "left")
    for row in rows.values():
        table.add_row(
            row.name, str(row.sent), str(row.lost), f"{row.p50_ms:.2f}", f"{row.p99_ms:.2f}", f"{row.max_ms:.2f}"
        )
    console.print(table)
    for key, value in figures.items():
        console.print(f"{key:34} {value:.2f}")
