"""The offline replay: what a sidecar reports when, and the judge."""

from __future__ import annotations

import math
import random

from bench.evaluation.generator import generate
from bench.matcher.calibration import DEADLINES_S, Cell, cells_of, paired, predict, share_calibrated
from bench.matcher.choosing import choose
from bench.matcher.crossed import cross
from bench.matcher.feed import LIFETIME_S, Reporter
from bench.matcher.online import follow
from bench.matcher.races import Probe, Race, Workload, replay
from plr.protos.convert import report_from_proto, report_to_proto


class Full(random.Random):
    """Makes every request a full race, or none."""

    def __init__(self, *, full: bool) -> None:
        super().__init__(0)
        self.full = full

    def randrange(self, *_: object, **__: object) -> int:
        return 0 if self.full else 1


def race(a: float, b: float) -> Race:
    return Race(0.0, (a, b), (0.01, 0.01))


def test_a_miss_is_told_at_the_deadline_and_its_latency_when_it_is_known() -> None:
    reporter = Reporter(0.1, Full(full=True))
    reporter.raced(race(0.05, math.inf))
    assert reporter.take(0.06).latencies[0].network.total == 1
    told = reporter.take(0.1)
    assert {report.interface: (report.requests, report.missed) for report in told.latencies} == {
        "a": (1, 0),
        "b": (1, 1),
    }
    assert [report.called_off.total for report in told.latencies] == [0, 1]
    assert [(joint.requests, joint.both_missed) for joint in told.joints] == [(1, 0)]
    reporter.raced(race(math.inf, 0.3))
    assert [(joint.requests, joint.both_missed) for joint in reporter.take(0.1).joints] == [(1, 1)]
    late = reporter.take(LIFETIME_S)
    assert [(report.network.answered, report.network.lost) for report in late.latencies] == [(0, 1), (1, 0)]


def test_of_a_request_that_is_no_full_race_only_the_pair_is_told() -> None:
    reporter = Reporter(0.1, Full(full=False))
    reporter.raced(race(0.05, 0.2))
    reporter.probed(Probe(0.0, 1, 0.02))
    report = reporter.take(1.0)
    assert report.latencies == ()
    assert [(joint.requests, joint.both_missed) for joint in report.joints] == [(1, 0)]
    assert [path.rtt.total for path in report.paths] == [0, 1]
    assert report_from_proto(report_to_proto(report)) == report


def test_predictions_meet_what_is_observed_on_random_paths() -> None:
    races = replay(generate("drive", 3, 600.0), Workload("20 kB", 20_000, 10.0))
    assert races == replay(generate("drive", 3, 600.0), Workload("20 kB", 20_000, 10.0)), "the same every time"
    predicted = {deadline_s: predict(races, deadline_s) for deadline_s in DEADLINES_S}
    cells = [cell for deadline_s in DEADLINES_S for cell in cells_of(races, deadline_s, predicted[deadline_s])]
    share = share_calibrated(cells)
    assert share is not None
    assert share > 0.75
    assert len({(cell.deadline_s, cell.kind) for cell in cells}) == len(cells)
    chosen = choose(races, predicted[0.5])
    assert chosen.misses["matcher"] <= 1.15 * chosen.misses["best fixed"]
    assert chosen.misses["matcher"] < min(chosen.misses["random"], chosen.misses["round robin"])
    assert 0 < chosen.switches < races.duration_s / 10
    for product, joint in paired(cells):
        assert joint.kind == "joint"
        assert product.observed == joint.observed
    for cell in cells:
        assert cell.low <= cell.expected <= cell.high or cell.expected < 1.0
        assert cell.requests == len(races.races)


def test_the_judge_counts_what_is_near_or_inside() -> None:
    def cell(observed: int, expected: float = 100.0, half: float = 10.0) -> Cell:
        return Cell("t", "w", 0.1, "a", 1000, expected, expected - half, expected + half, observed)

    assert share_calibrated([cell(149), cell(67), cell(151), cell(66), cell(9, expected=10.0)]) == 0.5
    assert share_calibrated([cell(160, half=60.0)]) == 1.0
    assert share_calibrated([cell(5, expected=20.0)]) is None
    assert cell(100).log_error == 0.0


def test_the_control_plane_maps_better_than_lots_where_one_of_three_servers_is_busy() -> None:
    drive = generate("drive", 3, 300.0)
    races = cross(drive, Workload("20 kB", 20_000, 10.0), 3)
    assert races == cross(drive, Workload("20 kB", 20_000, 10.0), 3), "the same every time"
    online = follow(races, 0.25, 3)
    assert online.misses["matcher"] <= 1.15 * online.misses["best fixed"]
    assert online.misses["matcher"] < min(online.misses["random"], online.misses["round robin"])
    assert 0 < online.switches < races.duration_s / 10
    assert 0 < online.explored <= 0.011 * online.requests
