"""When a run is void, and what the command line refuses."""

from __future__ import annotations

import argparse
from dataclasses import replace
from typing import TYPE_CHECKING

import pytest

from bench.evaluation import command
from bench.evaluation.report import RUNS, read_records
from bench.evaluation.runner import disturbances
from lab import DirectionStats, Lateness, LinkProfile, LinkStats

if TYPE_CHECKING:
    from pathlib import Path

QUIET = Lateness(1000, 0.0001, 0.001, 0.002)
DIRECTION = DirectionStats(1, 1, 1, 1, {}, 0, 0, 0, 0, LinkProfile())
LINK = LinkStats(DIRECTION, DIRECTION, None, True, QUIET, QUIET, 1, True, 0.0, 0.0)


def test_a_late_or_lossy_emulator_or_a_busy_machine_makes_a_run_void() -> None:
    assert disturbances({"wlan0": LINK}, 0.1) == ()
    assert disturbances({"wlan0": LINK}, None) == ()
    late = replace(LINK, lateness=replace(QUIET, p99_s=0.02))
    stepped = replace(LINK, step_lateness=replace(QUIET, max_s=0.3))
    lossy = replace(LINK, down=replace(DIRECTION, kernel_drops=3))
    told = disturbances({"one": late, "two": stepped, "three": lossy, "four": LINK}, 0.9)
    assert [text.partition(":")[0] for text in told[:-1]] == ["one", "two", "three"]
    assert "90%" in told[-1]


@pytest.mark.parametrize(
    ("scenario", "traces", "told"), [("no-such-*", None, "no scenario no-such-*"), ("drive-1", "bad", "index.json")]
)
def test_what_cannot_be_read_ends_in_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], scenario: str, traces: str | None, told: str
) -> None:
    parser = argparse.ArgumentParser()
    command.add_arguments(parser)
    arguments = ["--scenario", scenario, "--contender", "ideal", "--out", str(tmp_path)]
    if traces is not None:
        (tmp_path / traces).mkdir()
        (tmp_path / traces / "index.json").write_text("[1]")
        arguments += ["--traces", str(tmp_path / traces)]
    assert command.run(parser.parse_args(arguments)) == 2
    error = capsys.readouterr().err
    assert told in error
    assert error.count("\n") == 1


def test_a_run_that_is_resumed_repeats_what_is_void_or_missing(tmp_path: Path) -> None:
    parser = argparse.ArgumentParser()
    command.add_arguments(parser)
    common = ["--seconds", "5", "--scenario", "drive-1", "--out", str(tmp_path), "--no-report"]
    arguments = [*common, "--contender", "ideal", "--contender", "ideal-a"]
    assert command.run(parser.parse_args([*arguments, "--jobs", "2"])) == 0
    ideal_a, ideal = read_records(tmp_path)
    replace(ideal_a, disturbances=("busy",)).write(tmp_path / RUNS)
    assert command.run(parser.parse_args([*arguments, "--contender", "ideal-b", "--resume"])) == 0
    again = {one.contender: one for one in read_records(tmp_path)}
    at_once = {name: one.conditions["runs_at_once"] for name, one in again.items()}
    assert at_once == {"ideal": 2, "ideal-a": 1, "ideal-b": 1}
    assert not again["ideal-a"].disturbances
    assert again["ideal"] == ideal
