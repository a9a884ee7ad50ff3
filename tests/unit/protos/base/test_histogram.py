"""Properties of the latency histogram."""

from __future__ import annotations

import itertools
import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from plr.protos.base.errors import DecodeError
from plr.protos.base.histogram import BUCKETS, EDGES, GROWTH, LAYOUT, MAX_COUNT, MAX_S, MIDS, MIN_S, Histogram
from plr.protos.convert.types import histogram_to_proto

latencies = st.floats(min_value=MIN_S, max_value=MAX_S, exclude_max=True, allow_nan=False)
any_latency = st.floats(min_value=0.0, max_value=1e9, allow_nan=False) | st.just(math.inf)
samples = st.lists(any_latency, max_size=50)


def histogram_of(values: list[float], lost: int = 0) -> Histogram:
    histogram = Histogram()
    for value in values:
        histogram.record(value)
    histogram.record_lost(lost)
    return histogram


def test_layout_is_as_documented() -> None:
    assert len(EDGES) == BUCKETS - 1
    assert len(MIDS) == BUCKETS
    assert GROWTH <= 1.04
    assert EDGES[0] == MIN_S
    assert EDGES[-1] == MAX_S
    assert all(low < high for low, high in itertools.pairwise(EDGES))


@given(latencies)
def test_one_value_comes_back_within_two_percent(value: float) -> None:
    histogram = histogram_of([value])
    for estimate in (
        histogram.quantile(0.0),
        histogram.quantile(0.5),
        histogram.quantile(1.0),
        histogram.mean(),
    ):
        assert abs(estimate - value) <= 0.02 * value


@given(st.lists(latencies, min_size=1, max_size=200), st.floats(min_value=0, max_value=1))
def test_quantiles_are_those_of_the_sorted_values(values: list[float], q: float) -> None:
    exact = sorted(values)[max(1, math.ceil(q * len(values))) - 1]
    assert histogram_of(values).quantile(q) == pytest.approx(exact, rel=0.02)


@given(samples, st.integers(0, 5), st.floats(min_value=0, max_value=100))
def test_count_over_lies_between_the_neighbouring_buckets(values: list[float], lost: int, limit: float) -> None:
    over = histogram_of(values, lost).count_over(limit)
    surely = sum(value > limit * 1.04 + MIN_S for value in values) + lost
    at_most = sum(value > limit / 1.04 - MIN_S for value in values) + lost
    if limit < MAX_S:
        assert surely <= over <= at_most + 1e-9
    else:
        assert surely <= over <= sum(value >= MAX_S for value in values) + lost


@given(samples, st.integers(0, 5), st.lists(st.floats(min_value=0, max_value=100), min_size=2, max_size=20))
def test_count_over_falls_as_the_limit_grows(values: list[float], lost: int, limits: list[float]) -> None:
    histogram = histogram_of(values, lost)
    counted = [histogram.count_over(limit) for limit in sorted(limits)]
    assert counted == sorted(counted, reverse=True)
    assert all(lost <= over <= histogram.total for over in counted)


def test_count_over_interpolates_inside_a_bucket() -> None:
    histogram = histogram_of([MIDS[100]] * 100)
    low, high = EDGES[99], EDGES[100]
    assert histogram.count_over(low) == 100
    assert histogram.count_over(low + 0.25 * (high - low)) == pytest.approx(75)
    assert histogram.count_over(high) == 0


@given(samples, samples, st.integers(0, 9), st.integers(0, 9))
def test_merging_equals_recording_together(a: list[float], b: list[float], lost_a: int, lost_b: int) -> None:
    left, right = histogram_of(a, lost_a), histogram_of(b, lost_b)
    swapped = right.copy()
    swapped.merge(left)
    left.merge(right)
    assert left == histogram_of(a + b, lost_a + lost_b) == swapped
    assert right == histogram_of(b, lost_b)


@given(samples, samples)
def test_a_batch_equals_one_by_one(before: list[float], values: list[float]) -> None:
    batch = histogram_of(before)
    batch.record_many(values)
    assert batch == histogram_of(before + values)


@given(samples, samples, st.integers(0, 9), st.integers(0, 9))
def test_subtracting_the_past_leaves_what_came_since(a: list[float], b: list[float], lost_a: int, lost_b: int) -> None:
    total = histogram_of(a + b, lost_a + lost_b)
    total.subtract(histogram_of(a, lost_a))
    assert total == histogram_of(b, lost_b)


@pytest.mark.parametrize("other", [histogram_of([0.1, 0.1]), histogram_of([0.2]), histogram_of([], lost=2)])
def test_what_never_was_in_it_is_not_subtracted(other: Histogram) -> None:
    histogram = histogram_of([0.1], lost=1)
    with pytest.raises(ValueError, match="does not"):
        histogram.subtract(other)
    assert histogram == histogram_of([0.1], lost=1)


def test_the_wire_form_is_compact() -> None:
    """A second of a busy path: 1000 latencies spread over a decade."""
    spread = histogram_to_proto(histogram_of([0.02 * 10 ** (number / 1000) for number in range(1000)]))
    assert len(spread.SerializeToString()) < 200


@given(samples, st.integers(0, 9))
def test_sparse_form_round_trips(values: list[float], lost: int) -> None:
    histogram = histogram_of(values, lost)
    indices, counts, never = histogram.to_sparse()
    assert sum(counts) + never == histogram.total == len(values) + lost
    assert Histogram.from_sparse(indices, counts, never) == histogram


@given(
    st.lists(st.integers(-2, BUCKETS + 2), max_size=6),
    st.lists(st.integers(-1, 1 << 64), max_size=6),
    st.integers(-1, 1 << 64),
    st.integers(0, 3),
)
def test_any_sparse_form_parses_or_raises_decode_error(
    indices: list[int], counts: list[int], lost: int, layout: int
) -> None:
    try:
        histogram = Histogram.from_sparse(indices, counts, lost, layout=layout)
    except DecodeError:
        return
    assert histogram.to_sparse() == (indices, counts, lost)


@pytest.mark.parametrize(
    ("indices", "counts", "lost", "layout"),
    [
        ([1], [1], 0, LAYOUT + 1),
        ([2, 1], [1, 1], 0, LAYOUT),
        ([1, 1], [1, 1], 0, LAYOUT),
        ([BUCKETS], [1], 0, LAYOUT),
        ([-1], [1], 0, LAYOUT),
        ([1], [0], 0, LAYOUT),
        ([1], [MAX_COUNT + 1], 0, LAYOUT),
        ([1], [MAX_COUNT], 1, LAYOUT),
        ([1, 2], [MAX_COUNT // 2 + 1] * 2, 0, LAYOUT),
        ([1], [1, 1], 0, LAYOUT),
        ([], [], MAX_COUNT + 1, LAYOUT),
        ([], [], -1, LAYOUT),
    ],
)
def test_bad_sparse_forms_are_refused(indices: list[int], counts: list[int], lost: int, layout: int) -> None:
    with pytest.raises(DecodeError):
        Histogram.from_sparse(indices, counts, lost, layout=layout)


def test_the_lost_count_as_slower_than_anything() -> None:
    histogram = histogram_of([0.010] * 99, lost=1)
    assert histogram.count_over(1e9) == 1
    assert histogram.fraction_over(0.1) == pytest.approx(0.01)
    assert histogram.quantile(0.99) == pytest.approx(0.010, rel=0.02)
    assert histogram.quantile(1.0) == math.inf
    assert histogram.mean() == pytest.approx(0.010, rel=0.02)


def test_an_empty_histogram_knows_nothing() -> None:
    histogram = Histogram()
    assert histogram.total == 0
    assert math.isnan(histogram.quantile(0.5))
    assert math.isnan(histogram.mean())
    assert math.isnan(histogram.fraction_over(1.0))
    assert histogram.count_over(1.0) == 0


def test_take_returns_what_was_and_empties() -> None:
    histogram = histogram_of([0.1, 0.2], lost=3)
    taken = histogram.take()
    assert taken == histogram_of([0.1, 0.2], lost=3)
    assert histogram == Histogram()
    histogram.record(1.0)
    assert taken.total == 5


def test_nan_and_negative_counts_are_programming_errors() -> None:
    with pytest.raises(ValueError, match="NaN"):
        Histogram().record(math.nan)
    with pytest.raises(ValueError, match="NaN"):
        Histogram().record_many([0.1, math.nan])
    with pytest.raises(ValueError, match="negative"):
        Histogram().record_lost(-1)
    with pytest.raises(ValueError, match="quantile"):
        Histogram().quantile(1.5)


def test_clock_noise_below_zero_counts_as_zero() -> None:
    assert histogram_of([-0.5]) == histogram_of([0.0])
