"""Defines the targets of the evaluation's figures; `findings` computes the figures."""

from __future__ import annotations

from bench.evaluation.repeats import ALIKE
from bench.reporting.targets import Target

TARGETS = (
    Target(
        "drive_windows",
        "windows of recorded drives (120 s each) with both direct runs, plr-replicate and the ideal",
        at_least=10,
    ),
    Target(
        "mean_gain", "mean of the better direct run, divided by that of plr-replicate; median of windows", at_least=1.9
    ),
    Target(
        "p99_gain", "P99 of the better direct run, divided by that of plr-replicate; median of windows", at_least=2.4
    ),
    Target(
        "miss_excess",
        "plr-replicate's miss ratio, minus 1.1 times the ideal's, minus 0.005; worst window",
        at_most=0,
    ),
    Target(
        "good_p99_excess_ms",
        "plr-replicate's P99, minus 1.05 times the ideal's, minus 10 ms; worst window in which no direct run misses a "
        "request",
        at_most=0,
    ),
    Target(
        "queue_windows_below_ideal",
        "number of windows in which plr-replicate's P99 is below the ideal's, among those in which one carrier's rate "
        "is often below the load",
        at_least=3,
    ),
    Target(
        "adaptive_avoided", "misses that plr-adaptive avoids, divided by those that plr-replicate avoids", at_least=0.95
    ),
    Target(
        "adaptive_extra_bytes",
        "bytes that plr-adaptive sends beyond those of plr-single, divided by those of plr-single",
        at_most=0.25,
    ),
    Target(
        "budget_extra_share",
        "with a budget of 10 %: bytes of extra copies over one interface, divided by those of requests answered in "
        "time; worst run",
        at_most=0.1,
    ),
    Target("fallback_late", "case F, with a fallback: number of requests without an answer by the deadline", at_most=0),
    Target(
        "one_operator_mean_gain",
        "case G, both radios have one operator: plr-replicate's mean with one radio, divided by that with both; low, "
        "as the second radio helps little",
        at_most=1.9,
    ),
    Target(
        "one_operator_explained",
        "case G: share of the windows after which `plr explain` says that the paths fail together",
        at_least=1,
    ),
    Target(
        "reproduced_difference",
        "largest relative difference of a ratio between two evaluations of the same windows",
        at_most=ALIKE,
    ),
)
