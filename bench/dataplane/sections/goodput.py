"""Measures what one path carries on loopback and what it costs: bulk messages, and many small requests."""

from __future__ import annotations

import contextlib
from dataclasses import dataclass
from typing import TYPE_CHECKING

from bench.dataplane.ours import SERVICE, Ours
from bench.dataplane.remote import Remote
from bench.dataplane.section import Findings, Plot, Section
from bench.dataplane.statistics import MS, Calls, goodput_of_stretches, interval, median, median_ratio, ratio
from bench.dataplane.topology import cables, ethernet_loopback
from bench.reporting.tables import Table
from lab import Lab

if TYPE_CHECKING:
    from bench.dataplane.section import Context

BULK_BYTES = 1_000_000
AT_ONCE = 8
OURS_COUNT = 100
AIOQUIC_COUNT = 25
"""Messages for aioquic, which needs many times longer for each."""
WARM_UP = 10
SMALL_BYTES = 1_000
SMALL_COUNT = 3_000
SMALL_AT_ONCE = 32
PATIENT = {**SERVICE, "deadline_ms": 20_000.0, "lifetime_ms": 60_000.0}


@dataclass(frozen=True, slots=True)
class Bulk:
    """One run of bulk messages."""

    mbit_s: float | None
    cpu_ms_per_mb: float
    """Processor time of all its programs."""
    slices: list[float]
    """Mbit/s of each stretch of the run."""


def measure(context: Context) -> Findings:
    """Measure."""
    ours_runs: list[Bulk] = []
    ethernet_runs: list[Bulk] = []
    null_runs: list[Bulk] = []
    ethernet_null_runs: list[Bulk] = []
    aioquic_runs: list[Bulk] = []
    small: list[float | None] = []
    with contextlib.ExitStack() as stack:
        start = stack.enter_context
        ours = start(Ours(context.folder, clouds={"cloud_a": None}, service=PATIENT))
        null = start(Ours(context.folder, clouds={"cloud_a": None}, service=PATIENT, name="null", null_cipher=True))
        host = ethernet_loopback(start(Lab(cables())))
        ethernet = start(Ours(context.folder, robot=host, clouds={"cloud_a": host}, service=PATIENT, name="ethernet"))
        ethernet_null = start(
            Ours(
                context.folder,
                robot=host,
                clouds={"cloud_a": host},
                service=PATIENT,
                name="ethernet_null",
                null_cipher=True,
            )
        )
        server = start(Remote.start("quic", context.folder, name="quic.server"))
        client = start(Remote.start("quic", context.folder, name="quic.client"))
        client.ask("connect", host="127.0.0.1", port=server.ask("listen"))
        aioquic = (client, server)
        context.say("goodput: warming up")
        _bulk(ours.robot, WARM_UP)
        _bulk(ethernet.robot, WARM_UP)
        _bulk(null.robot, WARM_UP)
        _bulk(ethernet_null.robot, WARM_UP)
        _bulk(client, WARM_UP)
        for repeat in range(context.repeats):
            context.say(f"goodput: ours, {repeat + 1} of {context.repeats}")
            for runs, pair in (
                (ours_runs, ours),
                (null_runs, null),
                (ethernet_runs, ethernet),
                (ethernet_null_runs, ethernet_null),
            ):
                runs.append(_costed((pair.robot, *pair.clouds.values()), context.scaled(OURS_COUNT, WARM_UP)))
            context.say(f"goodput: aioquic, {repeat + 1} of {context.repeats}")
            aioquic_runs.append(_costed(aioquic, context.scaled(AIOQUIC_COUNT, WARM_UP)))
            context.say(f"requests a second: {repeat + 1} of {context.repeats}")
            count = context.scaled(SMALL_COUNT)
            calls = ours.call(size=SMALL_BYTES, count=count, at_once=SMALL_AT_ONCE, grace_s=20.0)
            small.append(ratio(_answered(calls), calls.duration_s()))
    figures = {
        "goodput_mbit_s": median(run.mbit_s for run in ours_runs),
        "aioquic_goodput_mbit_s": median(run.mbit_s for run in aioquic_runs),
        "goodput_over_aioquic": median(
            ratio(one.mbit_s, other.mbit_s) for one, other in zip(ours_runs, aioquic_runs, strict=True)
        ),
        "cpu_ms_per_mb": median(run.cpu_ms_per_mb for run in ours_runs),
        "goodput_null_cipher_mbit_s": median(run.mbit_s for run in null_runs),
        "sealed_over_null_goodput": median(
            ratio(one.mbit_s, other.mbit_s) for one, other in zip(ours_runs, null_runs, strict=True)
        ),
        "ethernet_goodput_null_cipher_mbit_s": median(run.mbit_s for run in ethernet_null_runs),
        "ethernet_sealed_over_null_goodput": median(
            ratio(one.mbit_s, other.mbit_s) for one, other in zip(ethernet_runs, ethernet_null_runs, strict=True)
        ),
        "ethernet_null_cipher_cpu_ms_per_mb": median(run.cpu_ms_per_mb for run in ethernet_null_runs),
        "null_cipher_cpu_ms_per_mb": median(run.cpu_ms_per_mb for run in null_runs),
        "ethernet_goodput_mbit_s": median(run.mbit_s for run in ethernet_runs),
        "ethernet_goodput_over_aioquic": median(
            ratio(one.mbit_s, other.mbit_s) for one, other in zip(ethernet_runs, aioquic_runs, strict=True)
        ),
        "ethernet_cpu_ms_per_mb": median(run.cpu_ms_per_mb for run in ethernet_runs),
        "aioquic_cpu_ms_per_mb": median(run.cpu_ms_per_mb for run in aioquic_runs),
        "requests_per_s": median(small),
    }
    rows: tuple[tuple[str, float | None, float | None], ...] = (
        ("ours", figures["goodput_mbit_s"], figures["cpu_ms_per_mb"]),
        ("ours, null cipher", figures["goodput_null_cipher_mbit_s"], figures["null_cipher_cpu_ms_per_mb"]),
        ("ours, packets of 1500 bytes", figures["ethernet_goodput_mbit_s"], figures["ethernet_cpu_ms_per_mb"]),
        (
            "ours, packets of 1500 bytes, null cipher",
            figures["ethernet_goodput_null_cipher_mbit_s"],
            figures["ethernet_null_cipher_cpu_ms_per_mb"],
        ),
        ("aioquic", figures["aioquic_goodput_mbit_s"], figures["aioquic_cpu_ms_per_mb"]),
    )
    title = f"{AT_ONCE} messages of 1 MB in flight, loopback, two processes"
    ours_slices, ethernet_slices, null_slices, ethernet_null_slices, aioquic_slices = (
        [rate for run in runs for rate in run.slices]
        for runs in (ours_runs, ethernet_runs, null_runs, ethernet_null_runs, aioquic_runs)
    )
    return Findings(
        figures=dict(figures),
        intervals={
            "goodput_mbit_s": interval(median, ours_slices),
            "goodput_over_aioquic": interval(median_ratio, ours_slices, aioquic_slices),
            "sealed_over_null_goodput": interval(median_ratio, ours_slices, null_slices),
            "ethernet_goodput_mbit_s": interval(median, ethernet_slices),
            "ethernet_goodput_over_aioquic": interval(median_ratio, ethernet_slices, aioquic_slices),
            "ethernet_sealed_over_null_goodput": interval(median_ratio, ethernet_slices, ethernet_null_slices),
        },
        tables=[
            Table(title, ("", "Mbit/s", "CPU ms/MB, both processes"), rows),
            Table(f"1 kB, {SMALL_AT_ONCE} in flight, engine to engine", ("", "1/s"), (("ours", median(small)),)),
        ],
        plots=[Plot("goodput of one path", "", "Mbit/s", bars={row[0]: row[1] for row in rows})],
    )


def _bulk(program: Remote, count: int) -> Calls:
    fields = {"size": BULK_BYTES, "count": count, "at_once": AT_ONCE, "grace_s": 60.0}
    return Calls.of(program.ask("call", timeout_s=120.0, **fields))


def _costed(programs: tuple[Remote, ...], count: int) -> Bulk:
    """Send `count` messages from the first program; return the run with its cost to all programs."""
    before = sum(program.ask("usage")["cpu_s"] for program in programs)
    calls = _bulk(programs[0], count)
    cpu_s = sum(program.ask("usage")["cpu_s"] for program in programs) - before
    megabytes = _answered(calls) * BULK_BYTES / 1e6
    return Bulk(
        ratio(megabytes * 8, calls.duration_s()),
        cpu_s * MS / max(megabytes, 1e-9),
        goodput_of_stretches(calls, BULK_BYTES),
    )


def _answered(calls: Calls) -> int:
    return sum(latency is not None for latency in calls.latency_s)


SECTION = Section("goodput", "Goodput, its cost, and requests a second", measure)
