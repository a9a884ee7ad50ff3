"""Two evaluations of the same windows: which runs are compared, and how far the ratios differ."""

from __future__ import annotations

import argparse
import json
from typing import TYPE_CHECKING

import pytest

from bench.evaluation import report_command
from bench.evaluation.findings import gather
from bench.evaluation.measured import Measured
from bench.evaluation.repeats import Repeats
from bench.evaluation.repeats import compare as compare_measured
from bench.evaluation.report import as_json
from bench.evaluation.targets import TARGETS
from tests.unit.bench.evaluation_records import drive, run

if TYPE_CHECKING:
    from pathlib import Path

    from bench.evaluation.outcome import Outcome


def compare(first: list[Outcome], second: list[Outcome]) -> Repeats:
    return compare_measured(Measured.of(first), Measured.of(second))


def verdict(first: list[Outcome], second: list[Outcome]) -> str:
    (target,) = (one for one in TARGETS if one.key == "reproduced_difference")
    return target.verdict(gather(first, Measured.of(second)).figures)


def test_ratios_of_the_runs_that_both_have_are_compared() -> None:
    first, second = [*drive(1, ours=4), *drive(2)], [*drive(1, ours=2), run("zenoh")]
    found = compare(first, second)
    assert (found.windows, found.runs) == (1, 3)
    gain = found.ratios["a-recorded, plr-replicate: mean gain"]
    assert (gain.first, gain.second) == pytest.approx((480 / 176, 480 / 138))
    assert gain.difference == pytest.approx(176 / 138 - 1)
    assert not any("zenoh" in name for name in found.ratios)
    assert found.largest is not None
    assert found.ratios[found.largest].difference >= gain.difference
    assert compare(first, []).largest is None


@pytest.mark.parametrize(("ours", "told"), [(10, "met"), (12, "met"), (14, "missed")])
def test_ratios_have_to_come_out_alike(ours: int, told: str) -> None:
    assert verdict(drive(direct=60, ours=10), drive(direct=60, ours=ours)) == told
    assert verdict(drive(), []) == "not measured"


def test_what_is_computed_need_not_be_done_again() -> None:
    first, second = ([*drive(direct=40, ours=ours, ideal=35)] for ours in (40, 45))
    without = [one for one in second if not one.contender.startswith("ideal")]
    assert compare(first, without) == compare(first, second)
    assert compare(first, second).ratios["plr-replicate: misses over the ideal's"].second == pytest.approx(45 / 35)
    few = drive(direct=40, ours=29, ideal=35)
    assert "plr-replicate: misses over the ideal's" not in compare(first, few).ratios


def test_cases_are_compared_each_by_itself() -> None:
    def wifi(ours: int) -> list[Outcome]:
        late = {"direct-a": 40, "direct-b": 20, "plr-1x2": 10, "plr-replicate": ours}
        return [run(name, scenario="two-wifi-1", case="C", late=count) for name, count in late.items()]

    found = compare([*drive(ours=1), *wifi(2)], [*drive(ours=1), *wifi(4)]).ratios
    assert found["a-recorded, plr-replicate: mean gain"].difference == 0.0
    assert found["c-two-wifi, plr-replicate: mean gain"].difference == pytest.approx(1 - 138 / 176)
    assert found["c-two-wifi, plr-replicate: mean gain over the worse"].first == pytest.approx(860 / 138)
    one_radio = found["c-two-wifi: mean with one radio over that with both"]
    assert (one_radio.first, one_radio.second) == pytest.approx((290 / 138, 290 / 176))


def test_an_evaluation_is_compared_with_published_figures_as_with_its_records(tmp_path: Path) -> None:
    first, second = [*drive(1, ours=4), *drive(2)], [*drive(1, ours=2), *drive(2, ours=3, void=True)]
    file = tmp_path / "evaluation.json"
    file.write_text(json.dumps(as_json(second, [])))
    assert Measured.published(file) == Measured.of(second)
    assert compare_measured(Measured.of(first), Measured.published(file)) == compare(first, second)


@pytest.mark.parametrize("text", ["", "{}", "[]", '{"runs": {"a": {"b": {}}}}', '{"runs": {"a": 1}}'])
def test_what_is_no_published_evaluation_is_refused(tmp_path: Path, text: str) -> None:
    file = tmp_path / "evaluation.json"
    file.write_text(text)
    with pytest.raises(ValueError, match=r"expected the data of a report, as docs/develop/results/evaluation\.json"):
        Measured.published(file)


def test_void_runs_are_no_repeats() -> None:
    second = [run(one.contender, scenario=one.scenario, void=True) for one in drive()]
    assert compare(drive(), second).runs == 0


@pytest.mark.parametrize(
    ("again", "told"),
    [
        ("first", "another evaluation"),
        ("first/evaluation.json", "another evaluation"),
        ("nothing", "no records"),
        ("page.html", "expected the data of a report"),
    ],
)
def test_what_is_no_repeat_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], again: str, told: str
) -> None:
    for one in drive():
        one.write(tmp_path / "first" / "evaluation")
    (tmp_path / "page.html").write_text("<html>")
    parser = argparse.ArgumentParser()
    report_command.add_arguments(parser)
    options = parser.parse_args(["--out", str(tmp_path / "first"), "--again", str(tmp_path / again)])
    assert report_command.run(options) == 2
    error = capsys.readouterr().err
    assert told in error
    assert error.count("\n") == 1
    assert not (tmp_path / "first" / "evaluation.json").exists()
