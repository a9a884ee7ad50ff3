"""Figures in README and docs: written from an evaluation's data, and what stands there now is just that."""

from __future__ import annotations

import hashlib
import json
import tarfile
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

from bench.evaluation import publish
from bench.evaluation.archive import pack
from bench.evaluation.blocks import NOTHING, all_blocks
from bench.evaluation.drives import Drives
from bench.evaluation.measured import Measured
from bench.evaluation.report import RUNS, as_json, read_records
from tests.unit.bench.evaluation_records import drive, run

if TYPE_CHECKING:
    from collections.abc import Mapping

    from bench.evaluation.outcome import Outcome

ROOT = Path(__file__).parents[4]
RESULTS = ROOT / publish.RESULTS
SVG = {"evaluation-charts/modes.svg": b"<svg/>"}
RECORDS = b"records"


def committed() -> dict[str, Any]:
    """The data that the repository keeps; empty before the first evaluation."""
    file = RESULTS / publish.DATA
    found: dict[str, Any] = json.loads(file.read_text(encoding="utf-8")) if file.exists() else {}
    return found


def evaluation() -> list[Outcome]:
    runs = drive(1, direct=20, ours=1, megabytes=20)
    beside = {"plr-single": 10, "plr-adaptive": 12, "mptcp": 15}
    return [*runs, *(run(name, scenario=runs[0].scenario, late=3, megabytes=size) for name, size in beside.items())]


def content(*outcomes: Outcome, again: list[Outcome] | None = None) -> Mapping[str, Any]:
    found: dict[str, Any] = json.loads(json.dumps(as_json(outcomes, [], None if again is None else Measured.of(again))))
    return found


def checkout(folder: Path, page: str | None = None) -> Path:
    """A checkout whose pages have a place for every block, or one page alone."""
    (folder / "docs" / "develop").mkdir(parents=True)
    blocks = "".join(f"<!-- evaluation: {name} -->\nold\n<!-- end -->\n" for name in all_blocks({}))
    (folder / "README.md").write_text(blocks if page is None else page)
    return folder


def test_figures_in_readme_and_docs_are_those_of_the_published_data() -> None:
    blocks = all_blocks(committed())
    stale = [file.name for file, text in publish.pages(ROOT).items() if publish.filled(text, blocks) != text]
    assert stale == [], "run `python -m bench report --publish`; never edit a figure by hand"


def test_published_files_are_as_they_were_written() -> None:
    files: dict[str, str] = committed().get(publish.FILES, {})
    assert {name: hashlib.sha256((RESULTS / name).read_bytes()).hexdigest() for name in files} == files


def test_the_pages_have_a_place_for_every_figure(tmp_path: Path) -> None:
    for file, text in publish.pages(ROOT).items():
        (tmp_path / file.relative_to(ROOT)).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / file.relative_to(ROOT)).write_text(text)
    written = publish.publish(tmp_path, content(*evaluation()), "summary", SVG, RECORDS)
    about = {one.file.relative_to(tmp_path).as_posix(): one.about for one in written}
    assert about["README.md"].endswith("figures in drives")
    assert about["docs/develop/results/evaluation.md"] == "1 charts beside it, 0 kB"
    assert publish.publish(tmp_path, content(*evaluation()), "summary", SVG, RECORDS) == written


def test_blocks_show_the_figures_of_the_data() -> None:
    again = [run("plr-replicate", late=2) if one.contender == "plr-replicate" else one for one in evaluation()]
    blocks = all_blocks(content(*evaluation(), again=again))
    drives = blocks["drives"]
    assert (
        "Every row covers all 1 windows of recorded drives, 100 requests together. Which of them are one drive was not"
        in drives
    )
    alone = "| ROS 2 over the better path of each window, chosen afterwards"
    assert f"{alone} | 20.0 % | - | 0.0 % | 480 ms | 100 ms | 2.0 s |" in drives
    assert "| `plr-replicate` | 1.0 % | - | 0.0 % | 119 ms | 100 ms | 100 ms | 100 ms | 200 |" in drives
    assert "mean is 4.03 times lower, and its P99 is 20 times lower (medians of the 1 windows)." in drives
    assert "zenoh" not in drives, "who did not run has no row"
    assert "multipath TCP | 1 | 3.0 % | 0.0 % | 157 ms | 100 ms | 2.0 s | 150 |" in blocks["others"]
    assert "multipath TCP | 0 : 1 | 0 : 0 | 0 : 1 | 0 : 0 | 0 : 1 | 1 : 0 |" in blocks["others"]
    assert "| `adaptive` | 1 | 3.0 % | 89 % | 20 % |" in blocks["modes"]
    assert "| `mean_gain` | 4.03 | ≥ 1.9 | met |" in blocks["verdicts"]
    assert "| `fallback_late` | not measured | ≤ 0 | not measured |" in blocks["verdicts"]
    assert "| driving, mean | 2.73, 1.9 | 7.23, 4.03 | 1 |" in blocks["paper"]
    assert "| a-recorded, plr-replicate: mean gain | 4.03 | 3.48 | 14 % |" in blocks["reproduced"]
    assert blocks["budgets"] == blocks["fallback"] == NOTHING


@pytest.mark.audit("ops-21")
def test_all_drives_are_shown_with_how_many_are_distinct_and_what_an_oracle_misses() -> None:
    """Not only those on which a direct run misses; whoever never answers has that share beside the tail."""
    hard, easy = (drive(number, direct=direct, ours=late) for number, direct, late in ((1, 20, 4), (2, 0, 0)))
    scenarios = [hard[0].scenario, easy[0].scenario]
    oracles = [run("oracle", scenario=name, late=late) for name, late in zip(scenarios, (1, 0), strict=True)]
    lost = run("mptcp", scenario=scenarios[0], late=5, late_s=20.0)
    found = as_json(
        [*hard, *easy, *oracles, lost, run("mptcp", scenario=scenarios[1])],
        [],
        drives=Drives((tuple(scenarios),), 1),
    )
    drives = all_blocks(found)["drives"]
    assert (
        "covers all 2 windows of recorded drives, 200 requests together. Only 1 of the windows are distinct" in drives
    )
    assert "multipath TCP | 2.5 % | 2.5 % | 2.5 % | 347 ms | 100 ms | no answer |" in drives
    assert "| `plr-replicate` | 2.0 % | 2.0 % | 0.0 % |" in drives
    assert "misses 0.5 %. This is 25 % of what `plr-replicate` misses." in drives
    assert "of all 2: " in all_blocks(found)["verdicts"], (
        "the gain over all drives stands beside that over the hard ones"
    )


@pytest.mark.audit("ops-21")
def test_each_distinct_drive_weighs_the_same() -> None:
    runs = [one for number, late in ((1, 30), (2, 30), (3, 0)) for one in drive(number, ours=late)]
    names = list(dict.fromkeys(one.scenario for one in runs))
    found = as_json(runs, [], drives=Drives(((names[0], names[1]), (names[2],)), 2))
    ours = found["everywhere"][0]["contenders"]["plr-replicate"]
    assert (ours["miss_ratio"], ours["distinct_miss_ratio"]) == (pytest.approx(0.2), pytest.approx(0.15))


def test_modes_that_ran_in_fewer_drives_have_a_table_of_these() -> None:
    modes = ("plr-single", "plr-hedge", "plr-adaptive")
    runs = [*drive(1), *drive(2), *(run(name, scenario=drive(1)[0].scenario) for name in modes)]
    blocks = all_blocks(as_json(runs, []))
    assert "all 2 windows" in blocks["drives"]
    assert "`plr-hedge`" not in blocks["drives"]
    assert "Every mode ran in 1 windows. In 1 of them, a direct run misses a request." in blocks["modes-drives"]
    assert "| `plr-hedge` |" in blocks["modes-drives"]


@pytest.mark.audit("ops-21")
def test_the_commits_that_were_measured_are_told() -> None:
    at = {"measured_at": "2026-01-02T03:04:05Z", "cpu": "one"}
    runs = drive(1, machine={**at, "commit": "abc"})
    assert "Commit: abc." in all_blocks(as_json(runs, []))["measured"]
    assert "Commit: not recorded." in all_blocks(as_json(drive(1, machine=at), []))["measured"]


def test_other_cases_have_a_table_of_their_own() -> None:
    late = {"direct-a": 60, "direct-b": 40, "plr-replicate": 2, "ideal": 1}
    wifi = [run(name, scenario=f"two-wifi-{n}", case="C", late=count) for n in (1, 2) for name, count in late.items()]
    table = all_blocks(content(*evaluation(), *wifi))["cases"]
    assert (
        "| C: two Wi-Fi, two-wifi | 2 | ROS 2 over the better path of each window, chosen afterwards | 40.0 % | 0.0 % |"
        in table
    )
    assert "|  |  | `plr-replicate` | 2.0 % |" in table
    assert "direct-a" not in table
    assert "A: driving" not in table


@pytest.mark.parametrize(
    ("page", "told"),
    [
        ("<!-- evaluation: drives -->\n", "in turn"),
        ("<!-- evaluation: drives -->\n<!-- evaluation: modes -->\n<!-- end -->\n<!-- end -->\n", "in turn"),
        ("<!-- evaluation: speed -->\n<!-- end -->\n", "speed"),
        ("no marks\n", "expected a checkout whose README.md or docs show drives"),
    ],
)
def test_nothing_is_published_where_the_marks_are_wrong(tmp_path: Path, page: str, told: str) -> None:
    root = checkout(tmp_path, page)
    with pytest.raises(ValueError, match=told):
        publish.publish(root, content(*evaluation()), "summary", {}, RECORDS)
    assert (root / "README.md").read_text() == page
    assert not (root / publish.RESULTS).exists()


def test_charts_that_are_no_more_are_removed(tmp_path: Path) -> None:
    root = checkout(tmp_path)
    publish.publish(root, content(*evaluation()), "summary", {"evaluation-charts/old.svg": b"", **SVG}, RECORDS)
    publish.publish(root, content(*evaluation()), "summary", SVG, RECORDS)
    assert [file.name for file in (root / publish.RESULTS).glob("*/*")] == ["modes.svg"]
    data = json.loads((root / publish.RESULTS / publish.DATA).read_text())
    assert data[publish.FILES]["evaluation.md"] == hashlib.sha256(b"summary").hexdigest()
    assert data[publish.FILES][publish.RECORDS] == hashlib.sha256(RECORDS).hexdigest()
    assert all_blocks(data)["drives"] in (root / "README.md").read_text()


def test_published_records_give_the_same_report(tmp_path: Path) -> None:
    (tmp_path / "packed.tar.xz").write_bytes(pack(evaluation(), RUNS))
    with tarfile.open(tmp_path / "packed.tar.xz") as archive:
        # extractall(filter=...) came with 3.11.4; Debian 12 has 3.11.2, and no xz unless asked for.
        archive.extraction_filter = getattr(tarfile, "data_filter", None)
        archive.extractall(tmp_path)
    assert content(*read_records(tmp_path)) == content(*evaluation())
    assert pack(read_records(tmp_path), RUNS) == pack(reversed(evaluation()), RUNS)
