"""Defines the targets of the matcher's figures; speeds are for two cores."""

from __future__ import annotations

from bench.reporting.targets import Target

TARGETS = (
    Target("calibration_share", "cells whose observed misses the prediction meets", at_least=0.9),
    Target(
        "calibration_joint_over_product",
        "error of predictions with measured correlation, over those without",
        at_most=1,
    ),
    Target("choice_over_best_fixed", "misses of the matcher's choices over those of the best fixed path", at_most=1.15),
    Target("choice_over_random", "over those of random choices", at_most=1),
    Target("choice_over_round_robin", "over those of turns", at_most=1),
    Target("choice_over_lowest_mean_rtt", "over those of the lowest mean round trip", at_most=1),
    Target("mapping_over_best_fixed", "several servers: misses of mappings over those of the best fixed", at_most=1.15),
    Target("mapping_over_best_fixed_held_out", "the same on traces by which nothing was chosen", at_most=1.15),
    Target("mapping_over_random", "over those of random mappings", at_most=1),
    Target("mapping_over_round_robin", "over those of turns", at_most=1),
    Target("mapping_over_lowest_mean_rtt", "over those of the lowest mean round trip", at_most=1),
    Target("resolve_one_of_1000_median_ms", "from a robot's report to its new mapping, ms", at_most=20),
    *(
        target
        for fleet, seconds, gap in (("1000x2x20", 3, 0.01), ("5000x4x50", 60, 0.03))
        for kind, more in (("", ""), ("_lifts", ", paths fail together"))
        for target in (
            Target(f"solve_{fleet}{kind}_s", f"robots x interfaces x servers from nothing{more}, s", at_most=seconds),
            Target(f"solve_{fleet}{kind}_gap", "its cost above the bound", at_most=gap),
        )
    ),
    Target("solve_1000x4x50_regions_excess", "interfaces beyond capacities within the default time limit", at_most=0),
    Target("solve_1000x4x50_regions_gap", "its cost above the bound, 3 regions", at_most=0.03),
    Target("live_follow_s", "in the lab: from two servers swapping load to the new mapping, s", at_most=5),
    Target("live_lost", "requests lost meanwhile", at_most=0),
)
