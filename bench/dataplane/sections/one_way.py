"""Measures the one-way time of a message on loopback: our engine, aioquic, plain UDP, each two processes with sockets.

It runs from the moment the message is handed over until the other process has all of it: by our engine's
ExecuteRequest, by the last byte of its QUIC stream, by the last of its datagrams. All connections are open and warm.
"""

from __future__ import annotations

import contextlib
from typing import TYPE_CHECKING

from bench.dataplane.ours import Ours
from bench.dataplane.remote import Remote
from bench.dataplane.section import Findings, Plot, Section
from bench.dataplane.statistics import MS, Interval, interval, median, median_ratio, quantile, ratio, worst
from bench.dataplane.topology import cables, ethernet_loopback
from bench.reporting.tables import Table
from lab import Lab

if TYPE_CHECKING:
    from collections.abc import Callable

    from bench.dataplane.section import Context

RATE_HZ = 40.0
COUNT = 80
WARM_UP = 20
SIZES = {"1k": 1_000, "150k": 150_000}
IN_MEMORY_COUNT = 30
NAMES = {"engine": "ours", "ethernet": "ours, packets of 1500 bytes", "aioquic": "aioquic", "udp": "plain UDP"}

Run = tuple[float | None, float | None]
"""Median and P99 of one repeat, milliseconds."""


def measure(context: Context) -> Findings:
    """Measure."""
    runs: dict[tuple[str, str], list[Run]] = {}
    pooled: dict[tuple[str, str], list[float]] = {}
    with contextlib.ExitStack() as stack:
        contenders = _start(context, stack)
        for name, run in contenders.items():
            for size in SIZES.values():
                context.say(f"one way: {NAMES[name]} warms up with {size} bytes")
                run(size, WARM_UP)
        for repeat in range(context.repeats):
            for key, size in SIZES.items():
                for name, run in contenders.items():
                    context.say(f"one way: {NAMES[name]}, {size} bytes, {repeat + 1} of {context.repeats}")
                    times = run(size, context.scaled(COUNT, 20))
                    runs.setdefault((name, key), []).append((quantile(times, 0.5), quantile(times, 0.99)))
                    pooled.setdefault((name, key), []).extend(times)
    figures = {f"{name}_{key}_ms": median(p50 for p50, _ in repeats) for (name, key), repeats in runs.items()}
    intervals: dict[str, Interval | None] = {}
    for name in ("engine", "ethernet"):
        key = f"{name}_150k_over_aioquic"
        pairs = zip(runs[name, "150k"], runs["aioquic", "150k"], strict=True)
        figures[f"{key}_of_repeats"] = median(ratio(ours[0], theirs[0]) for ours, theirs in pairs)
        both = pooled[name, "150k"], pooled["aioquic", "150k"]
        figures[key] = median_ratio(*both)
        intervals[key] = interval(median_ratio, *both)
    figures["aioquic_150k_memory_ms"] = _in_memory(context)
    rows = tuple(
        (f"{NAMES[name]}, {SIZES[key] // 1000} kB", figures[f"{name}_{key}_ms"], worst(p99 for _, p99 in repeats))
        for (name, key), repeats in runs.items()
    )
    memory = ("aioquic, 150 kB, in one process without sockets", figures["aioquic_150k_memory_ms"], None)
    return Findings(
        figures=dict(figures),
        intervals=intervals,
        tables=[Table("one-way time on loopback", ("", "median ms", "worst P99 ms"), (*rows, memory))],
        plots=[Plot("one-way time on loopback", "", "median, ms", bars={row[0]: row[1] for row in rows}, log_y=True)],
        notes=["engine_150k_over_aioquic compares real sockets with real sockets, two processes each."],
    )


def _start(context: Context, stack: contextlib.ExitStack) -> dict[str, Callable[[int, int], list[float]]]:
    """Start the contenders, each a function of (size, count) that returns one-way milliseconds."""
    start = stack.enter_context
    ethernet = ethernet_loopback(start(Lab(cables())))
    contenders = {
        "engine": _ours(start(Ours(context.folder, clouds={"cloud_a": None}))),
        "ethernet": _ours(start(Ours(context.folder, robot=ethernet, clouds={"cloud_a": ethernet}, name="ethernet"))),
    }
    for name, program in (("aioquic", "quic"), ("udp", "udp")):
        server = start(Remote.start(program, context.folder, name=f"{program}.server"))
        client = start(Remote.start(program, context.folder, name=f"{program}.client"))
        port = server.ask("listen")
        if program == "udp":
            client.ask("connect", paths=[(None, "127.0.0.1", port)])
        else:
            client.ask("connect", host="127.0.0.1", port=port)
        contenders[name] = _remote(client, server)
    return contenders


def _ours(ours: Ours) -> Callable[[int, int], list[float]]:
    def run(size: int, count: int) -> list[float]:
        ours.call(size=size, count=count, rate_hz=RATE_HZ)
        return [seconds * MS for seconds in ours.take_one_way()]

    return run


def _remote(client: Remote, server: Remote) -> Callable[[int, int], list[float]]:
    def run(size: int, count: int) -> list[float]:
        client.ask("call", size=size, count=count, rate_hz=RATE_HZ)
        return [seconds * MS for _, seconds in server.ask("take_one_way")]

    return run


def _in_memory(context: Context) -> float | None:
    context.say("one way: aioquic in memory")
    with Remote.start("quic", context.folder, name="quic.memory") as program:
        seconds = program.ask("in_memory", size=SIZES["150k"], count=context.scaled(IN_MEMORY_COUNT, 10))
    return median(value * MS for value in seconds)


SECTION = Section("one_way", "One-way time on loopback", measure)
