"""Turns plain values into Prometheus metric families."""

from __future__ import annotations

from bisect import bisect_left
from itertools import accumulate
from typing import TYPE_CHECKING, TypeVar

from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily

from plr.protos.base.histogram import MIDS

if TYPE_CHECKING:
    from collections.abc import Mapping

    from plr.protos.base.histogram import Histogram

DURATION_BOUNDS_S = (
    0.001, 0.002, 0.003, 0.005, 0.0075, 0.01, 0.015, 0.02, 0.03, 0.04, 0.05, 0.075, 0.1, 0.125, 0.15, 0.2, 0.25, 0.3,
    0.4, 0.5, 0.75, 1.0, 1.5, 2.0, 3.0, 5.0, 10.0, 30.0, 60.0,
)  # fmt: skip
"""Upper bounds of the exported buckets in seconds, dense in the range of robots' deadlines."""

K = TypeVar("K", bound=tuple[str, ...])
S = TypeVar("S", bound=str)


def counter(name: str, text: str, labels: tuple[str, ...], values: Mapping[K, float]) -> CounterMetricFamily:
    """Return a counter with `values` by label values; _total is added to its name."""
    family = CounterMetricFamily(name, text, labels=labels)
    for key, value in dict(values).items():
        family.add_metric(key, value)
    return family


def gauge(name: str, text: str, labels: tuple[str, ...], values: Mapping[K, float]) -> GaugeMetricFamily:
    """Return a gauge with `values` by label values."""
    family = GaugeMetricFamily(name, text, labels=labels)
    for key, value in dict(values).items():
        family.add_metric(key, float(value))
    return family


def by_one(values: Mapping[S, float]) -> dict[tuple[str, ...], float]:
    """Return the values keyed by tuples of one label."""
    return {(key,): count for key, count in dict(values).items()}


def cumulative(histogram: Histogram) -> tuple[list[tuple[str, float]], float]:
    """Return (upper bound, count up to it) and the sum of seconds; each bucket is placed by its middle (2 % error)."""
    inside = [0] * (len(DURATION_BOUNDS_S) + 1)
    indices, counts, _ = histogram.to_sparse()
    for index, count in zip(indices, counts, strict=True):
        inside[_POSITIONS[index]] += count
    names = (*map(str, DURATION_BOUNDS_S), "+Inf")
    return list(zip(names, map(float, accumulate(inside)), strict=True)), histogram.sum_s()


_POSITIONS = (*(bisect_left(DURATION_BOUNDS_S, middle) for middle in MIDS[:-1]), len(DURATION_BOUNDS_S))
"""Exported bucket of each bucket of the histogram; the overflow belongs to +Inf."""
