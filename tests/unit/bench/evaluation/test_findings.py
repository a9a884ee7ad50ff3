"""Verdicts of the evaluation, from made-up records: what counts, and both sides of each bound."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING

import pytest

from bench.evaluation import counters
from bench.evaluation.findings import gather
from bench.evaluation.targets import TARGETS
from tests.unit.bench.evaluation_records import DRIVE, drive, run

if TYPE_CHECKING:
    from collections.abc import Sequence

    from bench.evaluation.outcome import Outcome

BOTH_MISSED = "wlan0 -> cloud-a, wwan0 -> cloud-b: both missed 9 of 60, 5 times chance: "


def verdicts(outcomes: Sequence[Outcome]) -> dict[str, bool | None]:
    figures = gather(outcomes).figures
    return {target.key: target.met(figures) for target in TARGETS}


def test_nothing_is_measured_by_nothing() -> None:
    assert set(verdicts([]).values()) == {None}


def test_whole_recorded_drives_count_that_are_complete_and_not_void() -> None:
    ten = [one for number in range(10) for one in drive(number)]
    assert verdicts(ten)["drive_windows"] is True
    assert gather(ten[:-1]).figures["drive_windows"] == 9
    void = [*ten[:-1], run("plr-replicate", scenario=ten[-1].scenario, void=True)]
    assert gather(void).figures["drive_windows"] == 9
    shortened = [run(one.contender, scenario=f"{DRIVE}-15s") for one in drive()]
    made_up = [run(one.contender, scenario="drive-1") for one in drive()]
    assert "drive_windows" not in gather([*shortened, *made_up]).figures


@pytest.mark.parametrize(("ours", "met"), [(0, True), (19, False)])
def test_gains_are_over_the_better_direct_run(ours: int, met: bool) -> None:
    found = verdicts(drive(direct=20, ours=ours, ideal=0))
    assert (found["mean_gain"], found["p99_gain"]) == (met, met)


def test_gains_leave_out_drives_on_which_no_direct_run_misses() -> None:
    assert gather(drive(direct=0)).figures.get("mean_gain") is None


@pytest.mark.parametrize(("ours", "met"), [(11, True), (12, False)])
def test_misses_are_held_against_the_ideal_in_the_worst_drive(ours: int, met: bool) -> None:
    evidence = gather([*drive(1, ours=0, ideal=1), *drive(2, ours=ours, ideal=10)])
    assert (evidence.figures["miss_excess"] or 0.0) == pytest.approx(ours / 100 - 0.115)
    assert "a-drive-one-two-02-at-30" in evidence.notes["miss_excess"]
    assert verdicts(drive(ours=ours, ideal=10))["miss_excess"] is met


@pytest.mark.parametrize(("usual_s", "met"), [(0.114, True), (0.116, False)])
def test_p99_counts_where_no_direct_run_misses(usual_s: float, met: bool) -> None:
    good = drive(direct=0, ours=0, ideal=0, usual_s=usual_s)
    assert verdicts(good)["good_p99_excess_ms"] is met
    assert verdicts(drive(direct=1, ours=0, ideal=0, usual_s=usual_s))["good_p99_excess_ms"] is None


def test_queues_are_windows_of_any_case_where_one_path_is_below_the_load() -> None:
    def window(number: int, ours_s: float, path_late: int) -> list[Outcome]:
        of = partial(run, scenario=f"satellite-{number}", case="D")
        paths = [of("ideal-a", late=path_late), of("ideal-b"), of("ideal", usual_s=0.2)]
        return [*paths, of("plr-replicate", usual_s=ours_s)]

    faster = [one for number in range(3) for one in window(number, 0.19, 11)]
    slower = window(3, 0.21, 11)
    without_queue = window(4, 0.19, 10)
    evidence = gather([*faster, *slower, *without_queue])
    assert (evidence.figures["queue_windows_below_ideal"], evidence.figures["queue_windows"]) == (3, 4)
    assert verdicts(faster)["queue_windows_below_ideal"] is True
    assert verdicts([*faster[4:], *slower])["queue_windows_below_ideal"] is False


@pytest.mark.parametrize(("late", "megabytes", "met"), [(1, 12, (True, True)), (2, 13, (False, False))])
def test_adaptive_is_held_against_replicate_and_single(late: int, megabytes: int, met: tuple[bool, bool]) -> None:
    runs = [one for one in drive(direct=20, ours=0) if one.contender != "plr-replicate"]
    runs += [run("plr-replicate", megabytes=20), run("plr-single", late=15, megabytes=10)]
    runs.append(run("plr-adaptive", late=late, megabytes=megabytes))
    found = verdicts(runs)
    assert (found["adaptive_avoided"], found["adaptive_extra_bytes"]) == met


def counted(extra: float, *, ok: int = 90) -> dict[str, float]:
    """A hundred requests of 1 kB, nearly all first copies over one interface."""
    return {
        'plr_requests_total{outcome="ok",service="/echo"}': ok,
        'plr_requests_total{outcome="deadline_missed",service="/echo"}': 100 - ok,
        'plr_copy_bytes_total{copy="first",interface="wlan0",service="/echo"}': 99_000,
        'plr_copy_bytes_total{copy="first",interface="wwan0",service="/echo"}': 1_000,
        'plr_copy_bytes_total{copy="extra",interface="wwan0",service="/echo"}': extra,
    }


@pytest.mark.parametrize(("extra", "met"), [(9_000, True), (9_100, False)])
def test_a_budget_allows_a_tenth_of_what_was_answered_on_each_interface(extra: float, met: bool) -> None:
    runs = [run("plr-adaptive-10%", counters=counted(0)), run("plr-hedge-10%", counters=counted(extra))]
    evidence = gather(runs)
    assert evidence.figures["budget_extra_share"] == pytest.approx(extra / 90_000)
    assert "plr-hedge-10%" in evidence.notes["budget_extra_share"]
    assert verdicts(runs)["budget_extra_share"] is met
    assert verdicts([run("plr-hedge", counters=counted(extra))])["budget_extra_share"] is None


def test_what_was_not_counted_stays_unknown() -> None:
    assert counters.extra_share(run("plr-hedge-10%")) == {}
    assert counters.missed_by_network(run("plr-fallback")) is None


@pytest.mark.parametrize(("late", "met"), [(0, True), (1, False)])
def test_the_fallback_answers_what_the_network_misses(late: int, met: bool) -> None:
    of = partial(run, scenario="both-dark-1", case="F")
    evidence = gather([of("plr-fallback", late=late, counters=counted(0, ok=70))])
    assert evidence.figures["fallback_late"] == late
    assert evidence.figures["fallback_network_missed"] == 30
    assert verdicts([of("plr-fallback", late=late)])["fallback_late"] is met
    assert verdicts([run("plr-fallback", late=late)])["fallback_late"] is None


@pytest.mark.parametrize(
    ("one_radio_s", "said", "met"),
    [
        (0.18, "fail together", (True, True)),
        (0.2, "seem to fail together, but too little was seen to be sure", (False, True)),
        (0.18, "seldom fail together", (True, False)),
    ],
)
def test_one_operator_gains_little_and_the_explanation_says_why(
    one_radio_s: float, said: str, met: tuple[bool, bool]
) -> None:
    of = partial(run, scenario="one-operator-1", case="G")
    found = verdicts([of("plr-1x2", usual_s=one_radio_s), of("plr-replicate", explained=[f"{BOTH_MISSED}{said}"])])
    assert (found["one_operator_mean_gain"], found["one_operator_explained"]) == met
