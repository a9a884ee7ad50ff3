"""Link profiles as values, and the histogram of lateness."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from lab.errors import LabConfigError
from lab.lateness import LatenessHistogram
from lab.profile import LinkProfile


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("delay_ms", -1.0),
        ("delay_ms", math.nan),
        ("jitter_ms", math.inf),
        ("loss", 1.01),
        ("loss", math.nan),
        ("rate_kbps", -0.1),
        ("rate_kbps", math.nan),
        ("queue_bytes", -1),
        ("delay_ms", "20"),
        ("bandwidth", 5),
    ],
)
def test_senseless_profile_is_refused_by_the_name_of_the_field(field: str, value: object) -> None:
    with pytest.raises(LabConfigError, match=field if field != "delay_ms" or value != "20" else "number"):
        LinkProfile.from_json({field: value})


def test_profile_survives_json() -> None:
    profile = LinkProfile(delay_ms=3.5, jitter_ms=1, loss=0.25, rate_kbps=None, queue_bytes=7)
    assert LinkProfile.from_json(profile.to_json()) == profile


def test_empty_histogram_reports_zeros() -> None:
    assert LatenessHistogram().to_json() == {"count": 0, "p50_s": 0.0, "p99_s": 0.0, "max_s": 0.0}


@given(st.lists(st.floats(-0.001, 60.0), min_size=1, max_size=200), st.floats(0, 1))
def test_quantile_is_within_a_bucket_of_the_truth(durations: list[float], q: float) -> None:
    histogram = LatenessHistogram()
    for duration in durations:
        histogram.record(duration)
    ordered = sorted(max(0.0, duration) for duration in durations)
    truth = ordered[max(1, min(len(ordered), round(q * len(ordered)))) - 1]
    found = histogram.quantile(q)
    assert truth - 1e-9 <= found <= truth * (1 + 1 / 16) + 1e-6
    assert histogram.count == len(durations)


def test_duration_beyond_the_last_bucket_is_counted_there() -> None:
    histogram = LatenessHistogram()
    histogram.record(1000.0)
    assert histogram.max_s == 1000.0
    assert histogram.quantile(1.0) > 60
