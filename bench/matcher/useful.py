"""Section `useful`: do robots miss fewer deadlines with the control plane's mappings than with others?"""

from __future__ import annotations

import os
from concurrent.futures import ProcessPoolExecutor
from typing import TYPE_CHECKING

from bench.dataplane.section import Findings
from bench.matcher.crossed import cross
from bench.matcher.online import RIVALS, Online, follow
from bench.matcher.races import workloads_for
from bench.matcher.sources import load
from bench.reporting.tables import Figure, Table

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path

    from bench.matcher.races import Workload
    from lab.traces import Trace

SERVERS = (2, 3)
LARGE_BYTES = 100_000
DEADLINE_S = 0.25
LARGE_DEADLINE_S = 0.5
"""Deadline of requests of `LARGE_BYTES` and more."""


def measure(folder: Path | None, say: Callable[[str], None], *, quick: bool) -> Findings:
    """Replay every trace (of many of a family, one, if `quick`), with two servers and three in turn.

    The matcher's constants were chosen on traces with even numbers; the others were held out.
    """
    traces, note = load(folder)
    jobs = [
        (trace, workload, SERVERS[(number // 2 + turn) % len(SERVERS)], bool(number % 2))
        for number, (trace, kind) in enumerate(traces)
        for turn, workload in enumerate(workloads_for(kind))
    ]
    if quick:
        jobs = list({job[0].name.rpartition("-")[0]: job for job in jobs}.values())
    found: list[Online] = []
    with ProcessPoolExecutor(os.cpu_count()) as pool:
        for job, online in zip(jobs, pool.map(_follow, jobs), strict=True):
            say(f"useful: {job[0].name}")
            found.append(online)
    held_out = [online for job, online in zip(jobs, found, strict=True) if job[3]]
    findings = Findings(notes=[note] if note else [])
    findings.figures = _ratios(found, "") | _ratios(held_out, "_held_out") | _costs(found)
    findings.tables = [_table("all traces", found), _table("traces held out", held_out)]
    return findings


def _follow(job: tuple[Trace, Workload, int, bool]) -> Online:
    trace, workload, servers, _ = job
    deadline_s = LARGE_DEADLINE_S if workload.size >= LARGE_BYTES else DEADLINE_S
    return follow(cross(trace, workload, servers), deadline_s, servers)


def _ratios(found: Sequence[Online], suffix: str) -> dict[str, Figure]:
    matcher = sum(online.misses["matcher"] for online in found)
    figures: dict[str, Figure] = {}
    for rival in RIVALS:
        misses = sum(online.misses[rival] for online in found)
        figures[f"mapping_over_{rival.lower().replace(' ', '_')}{suffix}"] = matcher / misses if misses else None
    return figures


def _costs(found: Sequence[Online]) -> dict[str, Figure]:
    minutes = sum(online.duration_s for online in found) / 60.0
    requests = sum(online.requests for online in found)
    return {
        "mapping_switches_per_minute": sum(online.switches for online in found) / minutes,
        "mapping_explored_share": sum(online.explored for online in found) / requests,
    }


def _table(name: str, found: Sequence[Online]) -> Table:
    rows: list[tuple[str | Figure, ...]] = []
    for servers in SERVERS:
        part = [online for online in found if online.servers == servers]
        requests = sum(online.requests for online in part)
        ways = ("matcher", *RIVALS)
        rows.append(
            (
                f"{servers} servers",
                requests,
                *(sum(online.misses[way] for online in part) / requests if requests else None for way in ways),
                sum(online.switches for online in part),
            )
        )
    columns = ("", "requests", "matcher", *RIVALS, "switches")
    return Table(f"a copy over each of two interfaces, to different servers, miss ratio; {name}", columns, tuple(rows))
