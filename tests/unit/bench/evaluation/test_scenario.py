"""Scenario files, the rule by which windows are chosen, the ideal, and what an outcome says."""

from __future__ import annotations

import re
from dataclasses import asdict, replace
from typing import TYPE_CHECKING

import pytest

from bench.evaluation.comparison import Comparison, compare, gains, hard_windows, over_direct
from bench.evaluation.ideal import compute
from bench.evaluation.outcome import UNANSWERED_S, Outcome, Request, figures_by_window
from bench.evaluation.scenario import read_scenarios
from bench.evaluation.windows import choose, cut
from lab import LinkProfile, Trace, TraceStep
from lab.trace_folder import TraceEntry
from plr.protos.base.errors import ConfigError

if TYPE_CHECKING:
    from pathlib import Path

TEXT = """
name: some
case: A
about: a test
duration_s: 30
traffic: {request_bytes: 120000, answer_bytes: 1000, rate_hz: 5, deadline_ms: 1000, compute_ms: 20}
network: {generator: drive, seeds: [1, 2]}
"""


def entry(folder: Path, name: str, duration_s: float = 200.0, kind: str = "rate") -> TraceEntry:
    return TraceEntry(name, kind, ("one", "two"), duration_s, folder / name)


def flat(rate_kbps: float, seconds: int = 30) -> tuple[TraceStep, ...]:
    profile = LinkProfile(delay_ms=10.0, rate_kbps=rate_kbps)
    return tuple(TraceStep(float(at), profile, profile) for at in range(seconds))


def test_every_scenario_of_the_project_is_readable_and_every_case_has_one(tmp_path: Path) -> None:
    drives = [entry(tmp_path, f"drive-{pair}-{number:02}") for pair in ("p-q", "q-r", "r-s") for number in range(7)]
    scenarios = read_scenarios(drives)
    assert {scenario.case for scenario in scenarios} == set("ABCDEFG")
    assert len({scenario.name for scenario in scenarios}) == len(scenarios)
    assert sum(scenario.window is not None for scenario in scenarios) >= 10
    assert all(scenario.trace().duration_s == pytest.approx(scenario.duration_s) for scenario in read_scenarios([]))


@pytest.mark.parametrize(
    ("before", "after", "told"),
    [
        ("case: A", "case: Z", "some.yaml: case"),
        ("rate_hz: 5", "rate_hz: 0", "some.yaml: traffic.rate_hz"),
        ("generator: drive", "generator: dive", "some.yaml: network.generator: .*blind_spot"),
        ("generator: drive", 'generator: drive, traces: "*"', "either generator or traces"),
        ("duration_s", "duration", "some.yaml: duration"),
    ],
)
def test_a_bad_scenario_file_is_refused_in_one_line(tmp_path: Path, before: str, after: str, told: str) -> None:
    (tmp_path / "some.yaml").write_text(TEXT.replace(before, after))
    with pytest.raises(ConfigError) as refused:
        read_scenarios([], tmp_path)
    assert "\n" not in str(refused.value)
    assert re.search(told, str(refused.value))


def test_windows_are_chosen_by_name_and_length_alone(tmp_path: Path) -> None:
    names = [f"drive-x-{number:02}" for number in range(1, 8)]
    entries = [entry(tmp_path, name) for name in reversed(names)]
    entries += [entry(tmp_path, "drive-y-01", 60.0), entry(tmp_path, "drive-y-02", 121.0)]
    entries += [entry(tmp_path, "drive-z-01", kind="rtt"), entry(tmp_path, "walk-01")]
    assert [window.name for window in choose(entries, "drive-*", 3, 120.0)] == [
        "drive-x-01-at-40",
        "drive-x-03-at-40",
        "drive-x-05-at-40",
        "drive-y-02-at-0",
    ]


def test_a_cut_keeps_both_paths_on_one_clock() -> None:
    steps = tuple(TraceStep(float(at), LinkProfile(rate_kbps=at), LinkProfile(rate_kbps=at)) for at in range(10))
    part = cut(Trace("t", {"a": steps, "b": steps}), 2.5, 3.0)
    for path in "ab":
        assert [(step.at_s, step.up.rate_kbps) for step in part.path(path)] == [(0, 2), (0.5, 3), (1.5, 4), (2.5, 5)]


def test_the_ideal_takes_the_faster_path_of_each_request(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "some.yaml").write_text(TEXT)
    scenario = read_scenarios([], tmp_path)[0]
    # 120 kB take 0.96 s at 1 Mbit/s: a path for every fifth request.
    trace = Trace("t", {"a": flat(20_000.0), "b": flat(0.0)})
    monkeypatch.setattr(type(scenario), "trace", lambda _: trace)
    both, a, b = (compute(scenario, name) for name in ("ideal", "ideal-a", "ideal-b"))
    assert both.requests == a.requests
    assert both.figures().p99_ms == pytest.approx(120_000 * 8 / 20_000 + 20 + 1000 * 8 / 20_000 + 20)
    assert b.figures().unanswered_ratio == b.figures().miss_ratio == 1.0
    assert (scenario.shortened(10.0).count, scenario.shortened(10.0).name) == (50, "some-1-10s")
    assert scenario.shortened(30.0) == scenario


def test_no_request_is_slower_with_both_paths_than_with_one() -> None:
    (scenario,) = (one for one in read_scenarios([]) if one.name == "satellite-1")
    both, a, b = (compute(scenario, name).requests for name in ("ideal", "ideal-a", "ideal-b"))
    slower = [max(one.latency_s, other.latency_s) for one, other in zip(a, b, strict=True)]
    faster = [min(one.latency_s, other.latency_s) for one, other in zip(a, b, strict=True)]
    assert [request.latency_s for request in both] == pytest.approx(faster)
    assert faster != slower


def test_the_first_server_stalls_for_one_request_of_so_many(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "some.yaml").write_text(
        TEXT.replace("compute_ms: 20", "compute_ms: 20, stall_ms: 2000, stall_every: 10")
    )
    scenario = read_scenarios([], tmp_path)[0]
    monkeypatch.setattr(type(scenario), "trace", lambda _: Trace("t", {"a": flat(50_000.0), "b": flat(40_000.0)}))
    assert compute(scenario, "ideal").figures().miss_ratio == 0.0
    # Answers keep their order: what follows the one that stalled waits with it.
    late = [n for n, request in enumerate(compute(scenario, "ideal-a").requests) if request.latency_s > 1.5]
    assert late[:3] == [9, 10, 11]
    assert compute(scenario, "ideal-b").figures().miss_ratio > 0.05, "alone, it is the first server's"


def test_whoever_has_no_answer_counts_as_ten_seconds_and_the_sender_s_delay_counts() -> None:
    requests = (
        Request(0.0, 0.0, 0.1),
        Request(1.0, 1.5, 2.1),
        Request(2.0, 2.0, None),
        Request(3.0, 3.0, 3.0 + 2 * UNANSWERED_S),
    )
    figures = Outcome("s", "A", "c", 1000.0, requests, bytes_sent={"wlan0": 300, "wwan0": 100}).figures()
    assert (figures.miss_ratio, figures.unanswered_ratio) == (0.75, 0.5)
    assert figures.mean_ms == pytest.approx((0.1 + 1.1 + 20.0) / 4 * 1e3)
    assert figures.p99_ms == UNANSWERED_S * 1e3
    assert figures.bytes_per_request == 100.0


def test_an_outcome_is_written_and_read(tmp_path: Path) -> None:
    outcome = Outcome("s", "A", "c", 1000.0, (Request(0.0, 0.0, None),), {"wlan0": 1}, ("late",), {"p99_s": 0.1})
    assert Outcome.read(outcome.write(tmp_path)) == outcome
    file = replace(outcome, contender="d").write(tmp_path)
    assert file == tmp_path / "s" / "d.json"
    for text in ("{", "{}", '{"figures": {}, "requests": [{"x": 1}], "disturbances": []}'):
        file.write_text(text)
        with pytest.raises(ValueError, match=r"d\.json: expected the record of a run"):
            Outcome.read(file)


def ran(scenario: str, contender: str, *latencies_s: float | None, void: bool = False) -> Outcome:
    requests = tuple(Request(0.0, 0.0, latency_s) for latency_s in latencies_s)
    return Outcome(scenario, "A", contender, 1000.0, requests, disturbances=("late",) if void else ())


def test_a_contender_is_compared_with_the_better_direct_run_and_the_ideal() -> None:
    hard = [
        ran("hard", "direct-a", 0.4, 2.0),
        ran("hard", "direct-b", 0.2, None),
        ran("hard", "ideal", 0.1, 0.5),
        ran("hard", "ours", 0.2, 0.4),
    ]
    easy = [ran("easy", "direct-a", 0.4), ran("easy", "direct-b", 0.4), ran("easy", "ours", 0.1)]
    void = [ran("void", "direct-a", None), ran("void", "direct-b", 0.4, void=True), ran("void", "ours", 0.1)]
    found = compare([*hard, *easy, *void])
    hard_one = {"mean_gain": 4.0, "p99_gain": 5.0, "miss_over_ideal": 0.0, "p99_over_ideal": 0.8}
    assert asdict(found["hard"]["ours"]) == pytest.approx(hard_one)
    assert found["hard"]["direct-a"].miss_over_ideal == 0.5
    assert "ideal" not in found["hard"]
    assert found["easy"]["ours"].p99_gain == pytest.approx(4.0)
    assert found["void"]["ours"] == Comparison(None, None, None, None)
    gained = gains(figures_by_window([*hard, *easy, *void]))
    assert list(gained) == ["ours"]
    assert asdict(gained["ours"]) == pytest.approx(
        {"windows": 1, "mean_gain": 4.0, "p99_gain": 5.0, "median_mean_gain": 4.0, "median_p99_gain": 5.0}
    )


def test_gains_are_averaged_geometrically_and_the_medians_beside() -> None:
    directs = ((0.8, 1.6), (3.2, 1.2), (4.0, 3.6))
    windows = figures_by_window(
        [
            ran(f"window-{number}", name, latency_s)
            for number, (a, b) in enumerate(directs)
            for name, latency_s in (("direct-a", a), ("direct-b", b), ("ours", 0.4))
        ]
    )
    gained = gains(windows)["ours"]
    assert gained.windows == 3
    assert gained.mean_gain == pytest.approx((2 * 3 * 9) ** (1 / 3))
    assert gained.median_mean_gain == pytest.approx(3)
    hard = hard_windows(windows.values(), "ours")
    assert over_direct(hard, "ours", "p99_ms", max) == pytest.approx([4, 8, 10])
