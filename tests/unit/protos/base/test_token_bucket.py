"""The token bucket never lets more through than its burst and rate allow, and as much as they do."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from plr.protos.base.token_bucket import TokenBucket


def test_a_burst_goes_through_at_once_and_then_the_rate_decides() -> None:
    bucket = TokenBucket(rate=2.0, burst=3.0, now=10.0)
    assert [bucket.take(10.0) for _ in range(4)] == [True, True, True, False]
    assert not bucket.take(10.4)
    assert bucket.take(10.5)
    assert not bucket.take(10.5)
    # However long it rests, it holds no more than the burst.
    assert [bucket.take(1000.0) for _ in range(4)] == [True, True, True, False]


def test_what_is_not_there_is_not_taken() -> None:
    bucket = TokenBucket(rate=1.0, burst=5.0, now=0.0)
    assert not bucket.take(0.0, cost=6.0)
    assert bucket.take(0.0, cost=5.0)


def test_a_clock_that_goes_back_gives_nothing() -> None:
    bucket = TokenBucket(rate=1.0, burst=1.0, now=5.0)
    assert bucket.take(5.0)
    assert not bucket.take(1.0)
    assert not bucket.take(5.5)
    assert bucket.take(6.0)


@given(st.lists(st.tuples(st.floats(0.0, 2.0), st.floats(0.1, 4.0)), max_size=60))
def test_never_more_than_burst_and_rate_allow(steps: list[tuple[float, float]]) -> None:
    bucket = TokenBucket(rate=3.0, burst=5.0, now=0.0)
    now = taken = 0.0
    for pause, cost in steps:
        now += pause
        taken += cost if bucket.take(now, cost) else 0.0
        assert taken <= 5.0 + 3.0 * now + 1e-6
