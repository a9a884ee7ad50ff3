"""Section `speed`: how long plans of fleets take, and how far they are from the best."""

from __future__ import annotations

import random
import time
from dataclasses import replace
from statistics import median
from typing import TYPE_CHECKING

import numpy as np

from bench.dataplane.section import Figure, Findings, Table
from bench.matcher.fleets import flow_optimum, random_fleet
from controlplane.core.plan import relative_gap
from controlplane.matcher import Matcher
from protos.histogram import Histogram

if TYPE_CHECKING:
    from collections.abc import Callable

FLEETS = ((100, 2, 20), (1000, 2, 20), (5000, 4, 50))
"""Robots, interfaces of each, servers."""
QUICK_FLEETS = FLEETS[:2]
TIME_LIMIT_S = 60.0
RECORDS = 1_000_000
CHANGES = 60
"""Robots whose estimates change, one after the other."""


def measure(say: Callable[[str], None], *, quick: bool) -> Findings:
    """Solve fleets from nothing, and one robot after the other of a fleet."""
    findings = Findings()
    rows: list[tuple[str | Figure, ...]] = []
    for robots, interfaces, servers in QUICK_FLEETS if quick else FLEETS:
        for lifts in (False, True):
            if lifts and interfaces * servers > 40:
                continue  # half a gigabyte of lifts
            name = f"{robots}x{interfaces}x{servers}" + ("_lifts" if lifts else "")
            say(f"speed: {name}")
            row = _cold(name, robots, interfaces, servers, lifts, findings)
            rows.append(row)
    findings.tables.append(
        Table("whole fleets, from nothing", ("fleet", "s", "CPU s", "gap to own bound", "gap to flow"), tuple(rows))
    )
    say("speed: histogram")
    findings.figures |= _histogram()
    for lifts in (False, True):
        name = "one_of_1000" + ("_lifts" if lifts else "")
        say(f"speed: {name}")
        _one_by_one(name, lifts, findings)
    return findings


def _cold(
    name: str, robots: int, interfaces: int, servers: int, lifts: bool, findings: Findings
) -> tuple[str | Figure, ...]:
    problem = random_fleet(robots, interfaces, servers, seed=1, lifts=lifts)
    began, began_cpu = time.perf_counter(), time.process_time()
    plan = Matcher().solve(problem, time_limit_s=TIME_LIMIT_S)
    took, cpu = time.perf_counter() - began, time.process_time() - began_cpu
    optimum = None if lifts else flow_optimum(problem)
    beyond = None if optimum is None else relative_gap(plan.cost, optimum, abs(optimum))
    findings.figures |= {
        f"solve_{name}_s": took,
        f"solve_{name}_cpu_s": cpu,
        f"solve_{name}_gap": plan.gap,
        f"solve_{name}_excess": plan.relaxed,
    }
    if beyond is not None:
        findings.figures[f"solve_{name}_gap_to_flow"] = beyond
    return name, took, cpu, plan.gap, beyond


def _one_by_one(name: str, lifts: bool, findings: Findings) -> None:
    problem = random_fleet(1000, 2, 20, seed=1, lifts=lifts)
    other = random_fleet(1000, 2, 20, seed=2, lifts=lifts)
    matcher = Matcher()
    matcher.solve(problem, time_limit_s=TIME_LIMIT_S)
    took = []
    for number in random.Random(3).sample(range(1000), CHANGES):
        blocks = list(problem.blocks)
        blocks[number] = replace(other.blocks[number], key=blocks[number].key)
        problem = replace(problem, blocks=tuple(blocks))
        began = time.perf_counter()
        plan = matcher.solve(problem, time_limit_s=TIME_LIMIT_S)
        took.append(time.perf_counter() - began)
    findings.figures |= {
        f"resolve_{name}_median_ms": median(took) * 1e3,
        f"resolve_{name}_worst_ms": max(took) * 1e3,
        f"resolve_{name}_alone": matcher.incremental,
        f"resolve_{name}_gap": plan.gap,
    }


def _histogram() -> dict[str, Figure]:
    """Million records a second of CPU time, one by one and in batches."""
    values = np.random.default_rng(1).lognormal(-3.0, 1.0, RECORDS)
    histogram = Histogram()
    began = time.process_time()
    histogram.record_many(values)
    batch = time.process_time() - began
    singles = values.tolist()
    began = time.process_time()
    for value in singles:
        histogram.record(value)
    one_by_one = time.process_time() - began
    return {
        "histogram_million_records_per_s": RECORDS / batch / 1e6,
        "histogram_million_single_records_per_s": RECORDS / one_by_one / 1e6,
    }
