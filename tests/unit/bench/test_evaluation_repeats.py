"""Two evaluations of the same windows: which runs are compared, and how far the ratios differ."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

import pytest

from bench.evaluation import report_command
from bench.evaluation.findings import gather
from bench.evaluation.repeats import compare
from bench.evaluation.targets import TARGETS
from tests.unit.bench.evaluation_records import drive, run

if TYPE_CHECKING:
    from pathlib import Path

    from bench.evaluation.outcome import Outcome


def verdict(first: list[Outcome], second: list[Outcome]) -> str:
    (target,) = (one for one in TARGETS if one.key == "reproduced_difference")
    return target.verdict(gather(first, second).figures)


def test_ratios_of_the_runs_that_both_have_are_compared() -> None:
    first, second = [*drive(1, ours=4), *drive(2)], [*drive(1, ours=2), run("zenoh")]
    found = compare(first, second)
    assert (found.windows, found.runs) == (1, 3)
    gain = found.ratios["plr-replicate: mean gain"]
    assert (gain.first, gain.second) == pytest.approx((480 / 176, 480 / 138))
    assert gain.difference == pytest.approx(176 / 138 - 1)
    assert "zenoh: mean gain" not in found.ratios
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


def test_void_runs_are_no_repeats() -> None:
    second = [run(one.contender, scenario=one.scenario, void=True) for one in drive()]
    assert compare(drive(), second).runs == 0


@pytest.mark.parametrize(("again", "told"), [("first", "another evaluation"), ("nothing", "no records")])
def test_what_is_no_repeat_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], again: str, told: str
) -> None:
    for one in drive():
        one.write(tmp_path / "first" / "evaluation")
    parser = argparse.ArgumentParser()
    report_command.add_arguments(parser)
    options = parser.parse_args(["--out", str(tmp_path / "first"), "--again", str(tmp_path / again)])
    assert report_command.run(options) == 2
    error = capsys.readouterr().err
    assert told in error
    assert error.count("\n") == 1
    assert not (tmp_path / "first" / "evaluation.json").exists()
