"""Reads what the robot's own metrics say about a run of ours, from `conditions.counters`."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from bench.evaluation.outcome import Outcome

_LABEL = re.compile(r'(\w+)="([^"]*)"')


def total(run: Outcome, name: str, /, **labels: str) -> float | None:
    """Return the sum of a counter's series with these labels; None if not recorded."""
    values = [
        value
        for series, value in run.conditions.get("counters", {}).items()
        if series.partition("{")[0] == name and labels.items() <= dict(_LABEL.findall(series)).items()
    ]
    return sum(values) if values else None


def interfaces(outcome: Outcome) -> list[str]:
    """Return the interfaces over which copies went."""
    series = (one for one in outcome.conditions.get("counters", {}) if one.startswith("plr_copy_bytes_total{"))
    return sorted({dict(_LABEL.findall(one))["interface"] for one in series})


def extra_share(outcome: Outcome) -> dict[str, float]:
    """Return interface -> bytes of extra copies over those of requests answered in time; empty if not recorded.

    The figures cover the whole life of the sidecar, so that nothing was saved up before. The bytes answered are those
    of all first copies times the share of requests answered in time: all requests of a run have one size.
    """
    asked = total(outcome, "plr_requests_total")
    in_time = total(outcome, "plr_requests_total", outcome="ok")
    first = total(outcome, "plr_copy_bytes_total", copy="first")
    if not asked or not in_time or not first:
        return {}
    answered = first * in_time / asked
    return {
        name: (total(outcome, "plr_copy_bytes_total", copy="extra", interface=name) or 0.0) / answered
        for name in interfaces(outcome)
    }


def missed_by_network(outcome: Outcome) -> int | None:
    """Return how many requests the network did not answer in time, including the warm-up; None if not recorded."""
    asked = total(outcome, "plr_requests_total")
    in_time = total(outcome, "plr_requests_total", outcome="ok")
    return None if asked is None or in_time is None else round(asked - in_time)
