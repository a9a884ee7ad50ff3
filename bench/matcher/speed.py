"""Section `speed`: how long plans of fleets take, and how far they are from the optimum."""

from __future__ import annotations

import random
import time
from dataclasses import dataclass, replace
from statistics import median
from typing import TYPE_CHECKING

import numpy as np

from bench.dataplane.section import Findings
from bench.matcher.crowd import Crowd
from bench.matcher.fleets import ROOM, flow_optimum, in_regions, random_fleet
from bench.reporting.tables import Figure, Table
from plr.controlplane.config.controlplane import ControlPlaneConfig
from plr.controlplane.core.control.schedule import URGENT_DELAY_S
from plr.controlplane.core.problem.plan import relative_gap
from plr.controlplane.core.problem.problem import Objective
from plr.controlplane.solver.matcher import Matcher
from plr.protos.base.histogram import Histogram

if TYPE_CHECKING:
    from collections.abc import Callable

    from plr.controlplane.core.problem.problem import Problem

OVERLOAD_ROOM = 0.9
"""Capacity of the servers over the demand."""


@dataclass(frozen=True, slots=True)
class Fleet:
    """A fleet to be solved from scratch."""

    robots: int
    interfaces: int
    servers: int
    kind: str = ""
    """Variant: `lifts` (paths fail together), `regions` (several that copies should not share, and the control plane's
    own time limit), `sum_overload` (that objective, too few servers)."""

    @property
    def name(self) -> str:
        """Name in the figures' keys."""
        shape = f"{self.robots}x{self.interfaces}x{self.servers}"
        return f"{shape}_{self.kind}" if self.kind else shape

    def problem(self) -> Problem:
        """Return the problem."""
        overloaded = self.kind == "sum_overload"
        problem = random_fleet(
            self.robots,
            self.interfaces,
            self.servers,
            seed=1,
            lifts=self.kind == "lifts",
            room=OVERLOAD_ROOM if overloaded else ROOM,
        )
        if self.kind == "regions":
            return in_regions(problem, REGIONS, seed=2)
        return replace(problem, objective=Objective.SUM) if overloaded else problem


QUICK_FLEETS = (
    Fleet(100, 2, 20),
    Fleet(1000, 2, 20),
    Fleet(1000, 2, 20, "lifts"),
    Fleet(1000, 2, 20, "sum_overload"),
    Fleet(1000, 4, 50, "regions"),
)
FLEETS = (*QUICK_FLEETS, Fleet(5000, 4, 50), Fleet(5000, 4, 50, "lifts"), Fleet(5000, 4, 50, "sum_overload"))
REGIONS = 3
TIME_LIMIT_S = 60.0
DEFAULT_LIMIT_S = int(ControlPlaneConfig.model_fields["solver_time_limit_ms"].default) / 1000
RECORDS = 1_000_000
CHANGES = 60
"""Number of robots whose estimates change, one after the other."""
ROUNDS_TO_WARM_UP, ROUNDS = 3, 10
"""How often each robot of the fleet reports."""
SPACING_S = 0.02
"""Time between two changes."""


def measure(say: Callable[[str], None], *, quick: bool) -> Findings:
    """Solve fleets from scratch, and one robot after the other of a fleet."""
    findings = Findings()
    rows: list[tuple[str | Figure, ...]] = []
    for fleet in QUICK_FLEETS if quick else FLEETS:
        say(f"speed: {fleet.name}")
        rows.append(_cold(fleet, findings))
    findings.tables.append(
        Table("whole fleets, from nothing", ("fleet", "s", "CPU s", "gap to own bound", "gap to flow"), tuple(rows))
    )
    say("speed: histogram")
    findings.figures |= _histogram()
    for lifts in (False, True):
        name = "one_of_1000" + ("_lifts" if lifts else "")
        say(f"speed: {name}")
        _one_by_one(name, lifts, findings)
    say("speed: from report to mapping")
    crowd = Crowd(1000, 2, 20, seed=1)
    for _ in range(ROUNDS_TO_WARM_UP):
        crowd.tell_all()
    _from_report_to_mapping(crowd, findings)
    say("speed: turns")
    _turns(crowd, findings)
    return findings


def _turns(crowd: Crowd, findings: Findings) -> None:
    """Measure how long all streams wait for one report, a slice of a new problem, and a plan to be put into force, when
    the whole fleet reports once a second."""
    crowd.turns = {kind: [] for kind in crowd.turns}
    for _ in range(ROUNDS):
        crowd.tell_all()
    for kind, turns in crowd.turns.items():
        findings.figures[f"control_{kind}_p99_ms"] = float(np.quantile(turns, 0.99)) * 1e3
        findings.figures[f"control_{kind}_worst_ms"] = max(turns) * 1e3


def _from_report_to_mapping(crowd: Crowd, findings: Findings) -> None:
    """Measure the whole way in the control plane: a path of one robot dies, and its new mapping is ready to be sent."""
    took, took_cpu, sent = [], [], 0
    for robot in random.Random(3).sample(crowd.robots, CHANGES):
        report = crowd.report(robot, dead=("if0",))
        began, began_cpu = time.perf_counter(), time.process_time()
        crowd.tell(robot, report)
        crowd.now += URGENT_DELAY_S
        sent += crowd.solve()
        took.append(time.perf_counter() - began)
        took_cpu.append(time.process_time() - began_cpu)
        crowd.now += SPACING_S
    if sent < CHANGES:
        raise RuntimeError(f"{CHANGES} robots changed, and {sent} mappings were sent")
    findings.figures |= {
        "resolve_one_of_1000_median_ms": median(took) * 1e3,
        "resolve_one_of_1000_worst_ms": max(took) * 1e3,
        "resolve_one_of_1000_cpu_median_ms": median(took_cpu) * 1e3,
    }


def _cold(fleet: Fleet, findings: Findings) -> tuple[str | Figure, ...]:
    problem, name = fleet.problem(), fleet.name
    began, began_cpu = time.perf_counter(), time.process_time()
    plan = Matcher().solve(problem, time_limit_s=DEFAULT_LIMIT_S if fleet.kind == "regions" else TIME_LIMIT_S)
    took, cpu = time.perf_counter() - began, time.process_time() - began_cpu
    optimum = None if fleet.kind else flow_optimum(problem)
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
        f"solver_{name}_median_ms": median(took) * 1e3,
        f"solver_{name}_worst_ms": max(took) * 1e3,
        f"solver_{name}_alone": matcher.incremental,
        f"solver_{name}_gap": plan.gap,
    }


def _histogram() -> dict[str, Figure]:
    """Return million records a second of CPU time, one by one and in batches."""
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
