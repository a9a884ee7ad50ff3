"""The evaluation's reports, from made-up records: which windows are pooled, what page, summary and data show."""

from __future__ import annotations

import argparse
import json
from typing import TYPE_CHECKING

import pytest

from bench.evaluation import paper, report_command
from bench.evaluation.charts import COLOURS
from bench.evaluation.contenders import CONTENDERS
from bench.evaluation.scenario import read_scenarios
from bench.evaluation.studies import is_recorded, pool, studies
from tests.unit.bench.evaluation_records import drive, run

if TYPE_CHECKING:
    from pathlib import Path

    from bench.evaluation.outcome import Outcome


def reported(folder: Path, *runs: Outcome) -> int:
    for one in runs:
        one.write(folder / "evaluation")
    parser = argparse.ArgumentParser()
    report_command.add_arguments(parser)
    return report_command.run(parser.parse_args(["--out", str(folder)]))


def test_every_contender_has_a_colour_of_its_own() -> None:
    assert {*CONTENDERS, "ideal"} <= COLOURS.keys()
    assert len(set(COLOURS.values())) == len(COLOURS)


def test_studies_are_recorded_windows_of_a_case_and_scenario_files() -> None:
    made_up = [run("ideal", scenario=one.name, case=one.case) for one in read_scenarios([])]
    names = [study.name for study in studies([*made_up, *drive(1), *drive(2)])]
    assert names[:3] == ["a-recorded", "a-drive", "b-indoor"]
    assert "e-blind-spot" in names
    assert len(names) == len(set(names))
    shortened = studies([run("ideal"), run("ideal", scenario="drive-1-15s"), run("ideal", scenario="drive-1")])
    assert [study.name for study in shortened] == ["a-recorded", "a-drive", "a-drive-15s"]
    assert not is_recorded("drive-1")


def test_all_contenders_are_pooled_over_the_same_windows() -> None:
    runs = [one for number in range(4) for one in drive(number)]
    runs += [run("zenoh", scenario=one.scenario) for one in runs if one.contender == "ideal"][:3]
    runs += [run("mptcp", scenario=runs[0].scenario), run("plr-single", scenario=runs[0].scenario, void=True)]
    (study,) = studies(runs)
    found = pool(study.windows)
    assert found is not None
    assert set(found.runs) == {"direct-a", "direct-b", "zenoh", "plr-replicate", "ideal"}
    assert found.left_out == {"mptcp": 1}
    assert len(found.windows) == 3
    assert {len(of_one) for of_one in found.runs.values()} == {3}
    assert found.together("direct-a").figures().requests == 300
    assert pool({}) is None


def test_windows_without_direct_runs_or_ideal_do_not_count_beside_others() -> None:
    lonely = [run("plr-replicate", scenario=f"a-lonely-{number}-at-30") for number in range(9)]
    (study,) = studies([*drive(), *lonely])
    found = pool(study.windows)
    assert found is not None
    assert found.windows == ("a-drive-one-two-01-at-30",)
    assert "ideal" in found.runs


def test_contenders_that_never_ran_together_are_not_compared() -> None:
    (study,) = studies([run("direct-a", scenario="drive-1"), run("ideal", scenario="drive-2")])
    found = pool(study.windows)
    assert found is not None
    assert len(found.runs) == 1


def test_the_hardest_window_is_that_of_most_direct_misses() -> None:
    (study,) = studies([*drive(1, direct=5), *drive(2, direct=7), *drive(3, direct=6)])
    assert study.hardest(("ideal",)) == "a-drive-one-two-02-at-30"
    assert study.hardest(("zenoh",)) is None


def test_ratios_stand_beside_the_papers() -> None:
    windows = [*drive(1, direct=20, ours=0), *drive(2, direct=10, ours=0), *drive(3, direct=0, ours=0)]
    p99, mean = paper.ratios(studies([*windows, run("direct-a", scenario="drive-1")]))
    assert (p99.paper.over_worse, p99.paper.over_better) == (3.7, 2.46)
    assert (p99.windows, p99.hard_windows, p99.recorded) == (3, 2, True)
    assert (p99.over_worse, p99.over_better, p99.pooled_over_better) == pytest.approx((20, 20, 20))
    assert (mean.over_worse, mean.over_better) == pytest.approx(((8.6 * 4.8) ** 0.5, (4.8 * 2.9) ** 0.5))
    assert (mean.pooled_over_worse, mean.pooled_over_better) == pytest.approx((4.8, 2.9))


def test_the_reports_are_made_from_records_alone(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "evaluation.json").write_text('{"failed": ["one"]}')
    megabytes = {"plr-single": 10, "plr-adaptive": 12}
    machine = {"cpus": 2, "measured_at": "2026-01-02"}
    modes = [
        run(name, scenario=drive()[0].scenario, megabytes=size, machine=machine) for name, size in megabytes.items()
    ]
    assert reported(tmp_path, *drive(ours=1, megabytes=20), *modes) == 0
    assert "drive_windows" in capsys.readouterr().out
    content = json.loads((tmp_path / "evaluation.json").read_text())
    assert content["drive_windows"] == 1
    assert content["verdicts"]["drive_windows"] is False
    assert content["verdicts"]["fallback_late"] is content["fallback_late"] is None
    assert content["studies"]["a-recorded"]["contenders"]["direct-a"]["miss_ratio"] == pytest.approx(0.4)
    assert content["redundancy_modes"]["plr-adaptive"]["extra_bytes"] == pytest.approx(0.2)
    assert (content["machine"], content["failed"]) == (machine, ["one"])
    page = (tmp_path / "evaluation.html").read_text()
    summary = (tmp_path / "evaluation.md").read_text()
    for text in (page, summary):
        for shown in ("not measured", "driving, P99", "Redundancy modes", "Case A", "1 of 1 windows", "cpus: 2"):
            assert shown in text
    charts = sorted(file.name for file in (tmp_path / "evaluation-charts").iterdir())
    assert len(charts) == page.count("data:image/svg+xml") == 5
    assert all(f"(evaluation-charts/{chart})" in summary for chart in charts)


def test_what_never_counted_is_reported_too(tmp_path: Path) -> None:
    assert reported(tmp_path, run("plr-replicate", void=True)) == 0
    page = (tmp_path / "evaluation.html").read_text()
    assert "1 of them void" in page
    assert "<td>busy</td>" in page


@pytest.mark.parametrize(("broken", "told"), [(None, "no records"), ("evaluation/x/y.json", "y.json")])
def test_what_cannot_be_reported_ends_in_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], broken: str | None, told: str
) -> None:
    if broken:
        (tmp_path / broken).parent.mkdir(parents=True)
        (tmp_path / broken).write_text("{")
    assert reported(tmp_path) == 2
    error = capsys.readouterr().err
    assert told in error
    assert error.count("\n") == 1
