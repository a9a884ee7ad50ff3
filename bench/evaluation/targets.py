"""Defines the targets of the evaluation's figures; `findings` computes the figures."""

from __future__ import annotations

from bench.evaluation.repeats import ALIKE
from bench.reporting.targets import Target

TARGETS = (
    Target("drive_windows", "recorded drives of 120 s with both direct runs, plr-replicate and the ideal", at_least=10),
    Target("mean_gain", "mean of the better direct run over that of plr-replicate, median of drives", at_least=1.9),
    Target("p99_gain", "P99 of the better direct run over that of plr-replicate, median of drives", at_least=2.4),
    Target(
        "miss_excess",
        "plr-replicate's miss ratio above 1.1 times the ideal's and 0.005, worst drive",
        at_most=0,
    ),
    Target(
        "good_p99_excess_ms",
        "plr-replicate's P99 above 1.05 times the ideal's and 10 ms, worst drive where both direct runs miss nothing",
        at_most=0,
    ),
    Target(
        "queue_windows_below_ideal",
        "windows with one carrier below the load in which plr-replicate's P99 is below the ideal's",
        at_least=3,
    ),
    Target("adaptive_avoided", "of the misses that plr-replicate avoids, plr-adaptive avoids", at_least=0.95),
    Target("adaptive_extra_bytes", "bytes of plr-adaptive beyond those of plr-single, over them", at_most=0.25),
    Target(
        "budget_extra_share",
        "with a budget of 10 %, extra copies over an interface over requests answered in time, worst run",
        at_most=0.1,
    ),
    Target("fallback_late", "requests without an answer by the deadline, with a fallback, case F", at_most=0),
    Target(
        "one_operator_mean_gain",
        "mean of ours with one radio over that with both, where both radios have one operator: the second gives little",
        at_most=1.9,
    ),
    Target(
        "one_operator_explained",
        "share of those windows after which `plr explain` says that the paths fail together",
        at_least=1,
    ),
    Target(
        "reproduced_difference",
        "largest difference of any ratio between this evaluation and another one of the same windows",
        at_most=ALIKE,
    ),
)
