"""Defines what the judged windows must show (written before the runs that it judges).

*Clean* windows: the faster of two first-in-first-out paths (`ideal`) misses nothing. *Good* ones: it misses at most
GOOD of the requests. P99 counts a request without an answer as UNANSWERED_S. *Before* is `plr-replicate` as it was when
this was written (`before.json`). *Ours* is the mode that is the default.

One definition changed after the first runs, before ours were judged by it. The first one asked for at most half of
replicate's misses over all windows. No policy can have that on the judged half: even the clairvoyant oracle misses 0.54
of them, most in a single window. The figure over all windows stays in `drives.json`, without a target. The one with a
target counts the windows in which half is *attainable*: the causal oracle that repairs, which knows no more than a
sender can, misses at most half of replicate's there.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from bench.drives.contenders import FIFO, FIFO_ALONE
from bench.drives.oracles import Causal
from bench.evaluation.outcome import together
from bench.reporting.targets import Target

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from bench.evaluation.outcome import Figures, Outcome

    Runs = Mapping[str, Mapping[str, Outcome]]
    """Window -> contender -> run."""

GOOD = 0.01
ATTAINABLE = 0.5
"""Share of replicate's misses."""
SINGLE = "plr-single"

TARGETS = (
    Target("misses_over_causal_shared", "our misses over those of the causal oracle that shares", at_most=1.5),
    Target(
        "misses_over_replicate_where_attainable",
        "our misses over those of replicate before, where the causal oracle has at most half of them",
        at_most=0.5,
    ),
    Target(
        "clean_mean_over_fifo_ms", "clean windows: our mean less the FIFO pair's, the worst window, ms", at_most=0.0
    ),
    Target("clean_bytes_over_single", "clean windows: our bytes over those of one copy", at_most=1.25),
    Target("good_p99_over_fifo_ms", "good windows: our P99 less the FIFO pair's, the worst window, ms", at_most=5.0),
    Target("alone_misses_over_fifo", "one path: our misses less FIFO's, as a share, the worst of all", at_most=0.005),
    Target("alone_p99_over_fifo", "one path: our P99 over FIFO's, the worst of all", at_most=1.1),
)
"""The last two take `--alone`: each window and path counts by itself."""


def figures(runs: Runs, ours: str, before: Mapping[str, Figures]) -> dict[str, float]:
    """Return the figures of these windows; those that a missing contender is needed for are left out."""
    found: dict[str, float] = {}
    misses = {name: of[ours].figures().misses for name, of in runs.items() if ours in of}
    shared = {name: of[Causal.SHARED.value].figures().misses for name, of in runs.items() if Causal.SHARED.value in of}
    replicated = {name: before[name].misses for name in runs.keys() & before.keys()}
    attainable = {name: of for name, of in replicated.items() if _best_causal(runs[name]) <= ATTAINABLE * of}
    for key, anchor in (
        ("misses_over_causal_shared", shared),
        ("misses_over_replicate_before", replicated),
        ("misses_over_replicate_where_attainable", attainable),
    ):
        both = misses.keys() & anchor.keys()
        if both:
            found[key] = sum(misses[name] for name in both) / max(sum(anchor[name] for name in both), 1.0)
    clean = _windows(runs, ours, most=0.0)
    if clean:
        found["clean_mean_over_fifo_ms"] = max(of[ours].figures().mean_ms - of[FIFO].figures().mean_ms for of in clean)
    good = _windows(runs, ours, most=GOOD)
    if good:
        found["good_p99_over_fifo_ms"] = max(of[ours].figures().p99_ms - of[FIFO].figures().p99_ms for of in good)
    alone = [
        (of[f"{ours}-{path}"].figures(), of[fifo].figures())
        for of in runs.values()
        for path, fifo in FIFO_ALONE.items()
        if fifo in of and f"{ours}-{path}" in of
    ]
    if alone:
        found["alone_misses_over_fifo"] = max(mine.miss_ratio - fifo.miss_ratio for mine, fifo in alone)
        found["alone_p99_over_fifo"] = max(mine.p99_ms / fifo.p99_ms for mine, fifo in alone)
        usable = [mine.p99_ms / fifo.p99_ms for mine, fifo in alone if fifo.miss_ratio <= GOOD]
        if usable:
            found["alone_good_p99_over_fifo"] = max(usable)
    weighed = [of for of in clean if SINGLE in of]
    if weighed:
        found["clean_bytes_over_single"] = _bytes(weighed, ours) / _bytes(weighed, SINGLE)
    return found


def _best_causal(of: Mapping[str, Outcome]) -> float:
    oracle = of.get(Causal.REPAIR.value)
    return math.inf if oracle is None else oracle.figures().misses


def _windows(runs: Runs, ours: str, most: float) -> list[Mapping[str, Outcome]]:
    both = [of for of in runs.values() if ours in of and FIFO in of]
    return [of for of in both if of[FIFO].figures().miss_ratio <= most]


def _bytes(runs: Sequence[Mapping[str, Outcome]], contender: str) -> float:
    return together([of[contender] for of in runs]).figures().bytes_per_request or 0.0
