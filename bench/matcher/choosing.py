"""Compares choices of one path for each request: the matcher's, second by second, and those of others."""

from __future__ import annotations

import itertools
import random
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from bench.matcher.feed import PAIRS, REPORT_INTERVAL_S, ROBOT, SERVICE
from plr.controlplane.core.problem.plan import Plan, make_plan
from plr.controlplane.core.problem.problem import Block, BlockKey, Objective, Problem
from plr.controlplane.core.settle.stability import Stability

if TYPE_CHECKING:
    from collections.abc import Sequence

    from bench.matcher.calibration import Arrays
    from bench.matcher.races import Races
    from plr.controlplane.core.problem.problem import Choice

RIVALS = ("best fixed", "random", "round robin", "lowest mean RTT")
RTT_MEMORY = 0.98
"""Weight of the previous mean at each probe: a memory of 50 probes, a quarter of a second apart."""
_CHOICES: tuple[Choice, Choice] = ((0, None), (None, 1))


@dataclass(frozen=True, slots=True)
class Chosen:
    """Misses of every way to choose, over one trace, workload and deadline."""

    requests: int
    duration_s: float
    misses: dict[str, float]
    switches: int
    """How often the matcher changed its mind."""


def choose(races: Races, predicted: Arrays) -> Chosen:
    """Replay the choices. Both paths carry every request, so each choice is judged by what was really observed."""
    counts, estimates, misses = predicted
    means = estimates[..., 0] / estimates.sum(axis=-1)
    matcher, switches = _matcher(means[:, :2])
    ticks = np.arange(len(counts))
    singles = misses[:, :2]
    rtt = _lowest_rtt(races, len(counts))
    chance = random.Random(len(counts))
    by_lot = np.array([chance.randrange(2) for _ in ticks])
    return Chosen(
        int(counts.sum()),
        races.duration_s,
        {
            "matcher": float(singles[ticks, matcher].sum()),
            "best fixed": float(singles.sum(axis=0).min()),
            "random": float(singles[ticks, by_lot].sum()),
            "round robin": float(singles[ticks, ticks % 2].sum()),
            "lowest mean RTT": float(singles[ticks, rtt].sum()),
        },
        switches,
    )


def _matcher(means: np.ndarray[tuple[int, ...], np.dtype[np.float64]]) -> tuple[Sequence[int], int]:
    """Return the path taken in each interval and the number of switches, for a service limited to one server."""
    key = BlockKey(ROBOT, SERVICE)
    running, stability = Plan({}), Stability()
    chosen: list[int] = []
    last: tuple[float, float] | None = None
    for tick, (first, second) in enumerate(means.tolist()):
        if (first, second) != last:
            block = Block(
                key,
                tuple(pair.interface for pair in PAIRS),
                tuple(pair.server for pair in PAIRS),
                ((first, None), (None, second)),
                idempotent=False,
            )
            problem = Problem((block,), {}, Objective.JOINT)
            better = make_plan(problem, {key: _CHOICES[second < first]})
            running = stability.settle(problem, better, running, tick * REPORT_INTERVAL_S)
        last = (first, second)
        ((interface, _),) = running.blocks[key].assignments
        chosen.append(int(interface == PAIRS[1].interface))
    return chosen, sum(one != other for one, other in itertools.pairwise(chosen))


def _lowest_rtt(races: Races, ticks: int) -> Sequence[int]:
    """Return for each interval the path with the lower mean round trip of the probes answered so far."""
    interval_s = races.duration_s / ticks
    means = [0.0, 0.0]
    chosen: list[int] = []
    probes = iter(races.probes)
    probe = next(probes, None)
    for tick in range(ticks):
        while probe is not None and probe.at_s < tick * interval_s:
            if probe.rtt_s < 1.0:
                before = means[probe.path] or probe.rtt_s
                means[probe.path] = RTT_MEMORY * before + (1.0 - RTT_MEMORY) * probe.rtt_s
            probe = next(probes, None)
        chosen.append(int(means[1] < means[0]))
    return chosen
