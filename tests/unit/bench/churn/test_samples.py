from __future__ import annotations

import random
from dataclasses import replace

import pytest

from bench.churn.samples import MAX_GROWTH_MB, MAX_MORE_THREADS, Life, Sample, growth, slope_of

EVERY_S = 5.0
LENGTH_S = 600.0


def life(rss_mb_per_s: float = 0.0, *, born_s: float = 0.0, threads_at_end: int = 10) -> Life:
    rng = random.Random(1)
    samples = []
    at_s = born_s
    while at_s < LENGTH_S:
        samples.append(Sample(at_s, 100.0 + rss_mb_per_s * at_s + rng.uniform(-0.5, 0.5), 10))
        at_s += EVERY_S
    samples[-1] = replace(samples[-1], threads=threads_at_end)
    return Life("robot.sidecar", 1, samples)


@pytest.mark.parametrize(("grown_mb", "grows"), [(0.0, False), (MAX_GROWTH_MB / 2, False), (MAX_GROWTH_MB * 2, True)])
def test_memory_that_grows_through_the_second_half_is_found(grown_mb: float, grows: bool) -> None:
    found = growth(life(grown_mb / (LENGTH_S / 2)), LENGTH_S, EVERY_S)
    assert found.judged
    assert found.rss_mb == pytest.approx(grown_mb, abs=1.0)
    assert found.grows is grows


def test_what_grew_while_warming_up_is_no_leak() -> None:
    subject = life()
    subject.samples = [replace(s, rss_mb=50.0) if s.at_s < LENGTH_S / 4 else s for s in subject.samples]
    assert not growth(subject, LENGTH_S, EVERY_S).grows


@pytest.mark.parametrize(("more", "grows"), [(0, False), (MAX_MORE_THREADS, False), (MAX_MORE_THREADS + 1, True)])
def test_threads_that_add_up_are_found(more: int, grows: bool) -> None:
    assert growth(life(threads_at_end=10 + more), LENGTH_S, EVERY_S).grows is grows


def test_a_process_that_was_restarted_lately_is_not_judged() -> None:
    found = growth(life(1.0, born_s=LENGTH_S * 0.6), LENGTH_S, EVERY_S)
    assert not found.judged
    assert not found.grows
    assert not growth(life(1.0, born_s=LENGTH_S - 2 * EVERY_S), LENGTH_S, EVERY_S).judged


def test_a_short_run_is_not_judged() -> None:
    subject = life(1.0)
    subject.samples = [sample for sample in subject.samples if sample.at_s < 60.0]
    assert not growth(subject, 60.0, EVERY_S).judged


def test_the_sample_next_to_a_moment() -> None:
    subject = life(born_s=100.0)
    assert subject.near(0.0, 10.0) is None
    near = subject.near(152.0, 10.0)
    assert near is not None
    assert near.at_s == 150.0


def test_a_slope_of_nothing_is_flat() -> None:
    assert slope_of([(1.0, 5.0)]) == (0.0, 0.0)
    assert slope_of([(1.0, 5.0), (2.0, 7.0)]) == pytest.approx((2.0, 0.0))


def test_memory_that_comes_and_goes_by_chance_does_not_grow_and_a_leak_below_it_shows() -> None:
    rng, calm, leaking = random.Random(1), life(), life(0.1)
    for subject in (calm, leaking):
        subject.samples = [replace(s, rss_mb=s.rss_mb + 40.0 * rng.random() ** 2) for s in subject.samples]
    assert not growth(calm, LENGTH_S, EVERY_S).grows
    assert growth(leaking, LENGTH_S, EVERY_S).grows


def test_threads_of_a_connection_that_ends_and_begins_again_are_not_counted_as_growth() -> None:
    subject = life()
    subject.samples = [replace(s, threads=10 + 7 * (s.at_s % 60.0 < 30.0)) for s in subject.samples]
    assert growth(subject, LENGTH_S, EVERY_S).threads == 0
