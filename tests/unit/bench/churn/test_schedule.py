from __future__ import annotations

import itertools

import pytest

from bench.churn.schedule import (
    CALM_END_S,
    CONTROL,
    PATHS,
    SERVERS,
    SPARED_FROM,
    Kind,
    Lane,
    Trouble,
    make_schedule,
    others,
)

SEEDS = range(20)
LENGTH_S = 600.0


def lane_of(troubles: tuple[Trouble, ...], lane: Lane) -> list[Trouble]:
    return [trouble for trouble in troubles if trouble.lane is lane]


@pytest.mark.parametrize("seed", SEEDS)
def test_at_every_moment_one_path_and_one_server_are_well_and_rested(seed: int) -> None:
    troubles = make_schedule(seed, LENGTH_S)
    for lane in Lane:
        for before, after in itertools.pairwise(lane_of(troubles, lane)):
            assert after.begins_s >= before.ends_s + 2.0
    assert all(trouble.ends_s <= LENGTH_S - CALM_END_S for trouble in troubles)
    assert list(troubles) == sorted(troubles, key=lambda trouble: trouble.begins_s)


@pytest.mark.parametrize("seed", SEEDS)
def test_ten_minutes_have_every_kind_of_trouble_for_every_target(seed: int) -> None:
    seen = {(trouble.kind, trouble.target) for trouble in make_schedule(seed, LENGTH_S)}
    for lane, targets in ((Lane.PATHS, PATHS), (Lane.SERVERS, SERVERS[1:]), (Lane.CONTROL, (CONTROL,))):
        kinds = {trouble.kind for trouble in make_schedule(seed, LENGTH_S) if trouble.lane is lane}
        assert {(kind, target) for kind in kinds for target in targets} <= seen
    assert {kind for kind, _ in seen} == set(Kind)


@pytest.mark.parametrize("seed", SEEDS)
def test_what_is_judged_for_growth_lives_through_the_second_half(seed: int) -> None:
    for trouble in make_schedule(seed, LENGTH_S):
        if trouble.begins_s >= LENGTH_S * SPARED_FROM:
            assert trouble.target != CONTROL
            assert trouble.target != SERVERS[0] or trouble.kind is Kind.KILL_ROS


def test_a_seed_gives_one_schedule_and_another_seed_another() -> None:
    assert make_schedule(1, LENGTH_S) == make_schedule(1, LENGTH_S)
    assert make_schedule(1, LENGTH_S) != make_schedule(2, LENGTH_S)


@pytest.mark.parametrize("length_s", [1.0, 12.0, 45.0])
def test_a_short_run_has_what_fits(length_s: float) -> None:
    troubles = make_schedule(1, length_s)
    assert all(trouble.ends_s <= length_s - CALM_END_S for trouble in troubles)
    assert bool(troubles) is (length_s > 20.0)


def test_the_others_of_a_lane_have_to_work() -> None:
    assert others(Trouble(Lane.PATHS, Kind.UNPLUG, "wlan0", 0.0, 1.0)) == ("wwan0",)
    assert others(Trouble(Lane.CONTROL, Kind.KILL_CONTROL, CONTROL, 0.0, 1.0)) == ()
