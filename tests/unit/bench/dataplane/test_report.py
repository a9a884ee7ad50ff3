"""From requests to verdicts and the page, of bench/dataplane."""

from __future__ import annotations

import json
import random
from html.parser import HTMLParser
from typing import TYPE_CHECKING

import pytest

from bench.dataplane import page
from bench.dataplane.calling import HEADER, Caller, Plan
from bench.dataplane.report import Report
from bench.dataplane.section import Context, Findings, Plot, Section
from bench.dataplane.statistics import (
    Calls,
    Interval,
    Row,
    difference,
    interval,
    median,
    median_ratio,
    p99,
    quantile,
    ratio,
    worst,
)
from bench.dataplane.targets import TARGETS
from bench.reporting.tables import Table
from bench.reporting.targets import Target

if TYPE_CHECKING:
    from pathlib import Path

CALLS = Calls(sent_s=(1.0, 2.0, 3.0, 4.0), latency_s=(0.001, None, 0.003, 0.002))


def test_a_row_counts_the_unanswered_as_lost_and_only_there() -> None:
    row = CALLS.row("run")
    assert (row.sent, row.lost) == (4, 1)
    assert [row.p50_ms, row.p99_ms, row.max_ms] == pytest.approx([2, 3, 3])


def test_a_run_without_answers_has_no_latencies() -> None:
    row = Calls(sent_s=(1.0,), latency_s=(None,)).row("run")
    assert (row.sent, row.lost, row.p50_ms, row.p99_ms, row.max_ms) == (1, 1, None, None, None)
    assert Calls(sent_s=(1.0,), latency_s=(None,)).duration_s() is None


def test_a_stretch_holds_what_was_sent_in_it() -> None:
    assert CALLS.between(2.0, 4.0) == Calls((2.0, 3.0), (None, 0.003))


def test_duration_ends_with_the_last_answer() -> None:
    assert CALLS.duration_s() == pytest.approx(3.002)


def test_repeats_are_summed_or_their_median_or_worst_taken() -> None:
    rows = [Row("a", 10, lost, p50, p50 * 2, p50 * 3) for lost, p50 in ((0, 1.0), (2, 5.0), (0, 2.0))]
    assert Row.of_repeats(rows) == Row("a", 30, 2, 2.0, 4.0, 15.0)


def test_what_was_not_measured_stays_unknown() -> None:
    assert median([None, None]) is None
    assert median([None, 3.0, 1.0]) == 2.0
    assert worst([]) is None
    assert ratio(1.0, None) is None
    assert ratio(None, 1.0) is None
    assert ratio(1.0, 0.0) is None
    assert difference(3.0, 1.0) == 2.0
    assert difference(3.0, None) is None
    assert quantile([], 0.5) is None


def test_an_interval_narrows_with_the_samples_and_holds_the_figure() -> None:
    rng = random.Random(1)
    few, many = ([rng.gauss(10.0, 1.0) for _ in range(count)] for count in (20, 2_000))
    narrow, wide = interval(median, many), interval(median, few)
    assert narrow is not None
    assert wide is not None
    assert narrow.low < 10.0 < narrow.high
    assert narrow.high - narrow.low < 0.3 < wide.high - wide.low
    assert (narrow.samples, wide.samples) == (2_000, 20)
    assert interval(median, many) == narrow  # the same samples tell the same


def test_an_interval_of_two_sets_counts_the_smaller_one() -> None:
    found = interval(median_ratio, [2.0, 2.1, 1.9, 2.0], [1.0, 1.05, 0.95] * 10)
    assert found is not None
    assert found.low < 2.0 < found.high
    assert found.samples == 4


@pytest.mark.parametrize("samples", [[], [1.0]])
def test_too_few_samples_have_no_interval(samples: list[float]) -> None:
    assert interval(p99, samples) is None


@pytest.mark.parametrize(
    ("value", "other", "met"),
    [(800, None, True), (799, None, False), (100, 5.0, True), (100, 4.9, False), (None, 9.0, None)],
)
def test_a_target_may_be_met_another_way(value: float | None, other: float | None, met: bool | None) -> None:
    target = Target("goodput", "", at_least=800, or_key="beside", or_at_least=5)
    assert target.met({"goodput": value, "beside": other}) is met


@pytest.mark.parametrize(("value", "met"), [(0.2, False), (0.25, True), (4, True), (4.1, False)])
def test_both_bounds_hold(value: float, met: bool) -> None:
    assert Target("share", "", at_least=0.25, at_most=4).met({"share": value}) is met


def test_every_target_has_a_bound_and_its_own_key() -> None:
    assert len({target.key for target in TARGETS}) == len(TARGETS)
    assert all(target.at_least is not None or target.at_most is not None for target in TARGETS)


class Reader(HTMLParser):
    def __init__(self) -> None:
        super().__init__()
        self.text = ""
        self.images = 0

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        source = dict(attrs).get("src")
        assert source is None or source.startswith("data:")
        self.images += tag == "img"

    def handle_data(self, data: str) -> None:
        self.text += f"{data} "


def test_the_page_shows_verdicts_tables_and_plots_and_loads_nothing() -> None:
    report = Report({"cpus": 2}, quick=False, repeats=3)
    findings = Findings(
        figures={"blackhole_lost": 1, "blackhole_p99_ms": 0.96},
        tables=[Table("lost & found", ("", "ms"), (("ours", 1.5), ("theirs", None)))],
        plots=[
            Plot("bars", "", "ms", bars={"ours": 1.0, "theirs": None}),
            Plot("lines", "s", "ms", lines={"ours": [(0.0, 1.0), (1.0, 2.0)]}, log_y=True),
        ],
        notes=["a < b"],
        intervals={"blackhole_p99_ms": Interval(0.9, 1.25, 400), "fec_p99_over_lossfree_2pct": None},
    )
    report.add(Section("blackhole", "A path goes silent", lambda _context: findings), findings, 1.23)
    reader = Reader()
    reader.feed(page.render(report))
    assert reader.images == 2
    for shown in (
        "A path goes silent",
        "lost & found",
        "a < b",
        "met",
        "missed",
        "not measured",
        "0.96",
        "0.9 to 1.25, 400 samples",
    ):
        assert shown in reader.text
    content = json.loads(json.dumps(report.as_json()))
    assert content["blackhole_lost"] == 1
    assert content["intervals"] == {"blackhole_p99_ms": {"low": 0.9, "high": 1.25, "samples": 400}}
    assert content["verdicts"]["blackhole_lost"] is False
    assert content["verdicts"]["blackhole_p99_ms"] is True
    assert content["verdicts"]["loss_lost"] is content["loss_lost"] is None


def test_a_quick_run_scales_counts_down_but_not_below_the_least(tmp_path: Path) -> None:
    quick = Context(tmp_path, 1, quick=True, say=lambda _text: None)
    assert (quick.scaled(100), quick.scaled(10, at_least=8)) == (20, 8)


def test_a_caller_counts_first_answers_of_its_own_run_only() -> None:
    sent: list[bytes] = []

    def send(number: int, data: bytes) -> None:
        sent.append(data)
        if number % 2 == 0:
            caller.answered(data, HEADER.unpack_from(data)[1] + 0.5)
            caller.answered(data, HEADER.unpack_from(data)[1] + 0.9)

    caller = Caller(send)
    first = Calls.of(caller.call(Plan(size=100, count=3, rate_hz=1e6, grace_s=0.0)))
    assert first.latency_s[1] is None
    assert first.latency_s[0] == pytest.approx(0.5)
    assert {len(data) for data in sent} == {100}
    caller.answered(sent[1], 0.0)  # late: of the run before
    second = Calls.of(caller.call(Plan(size=100, count=2, rate_hz=1e6, grace_s=0.0)))
    assert [latency is None for latency in second.latency_s] == [True, False]


def test_a_closed_loop_stops_when_no_answer_comes() -> None:
    caller = Caller(lambda _number, _data: None)
    calls = Calls.of(caller.call(Plan(size=16, count=10, at_once=2, grace_s=0.0)))
    assert len(calls.sent_s) == 2
