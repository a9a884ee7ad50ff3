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
from bench.evaluation.measured import Measured
from bench.evaluation.report import RUNS, as_json, read_records
from tests.unit.bench.evaluation_records import drive, run

if TYPE_CHECKING:
    from collections.abc import Mapping

    from bench.evaluation.outcome import Outcome

ROOT = Path(__file__).parents[3]
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
    (folder / "docs").mkdir()
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
        (tmp_path / file.relative_to(ROOT)).parent.mkdir(exist_ok=True)
        (tmp_path / file.relative_to(ROOT)).write_text(text)
    written = publish.publish(tmp_path, content(*evaluation()), "summary", SVG, RECORDS)
    about = {one.file.relative_to(tmp_path).as_posix(): one.about for one in written}
    assert about["README.md"].endswith("figures in drives")
    assert about["docs/results/evaluation.md"] == "1 charts beside it, 0 kB"
    assert publish.publish(tmp_path, content(*evaluation()), "summary", SVG, RECORDS) == written


def test_blocks_show_the_figures_of_the_data() -> None:
    again = [run("plr-replicate", late=2) if one.contender == "plr-replicate" else one for one in evaluation()]
    blocks = all_blocks(content(*evaluation(), again=again))
    drives = blocks["drives"]
    assert "1 drives, 100 requests each" in drives
    assert "| ROS 2 over the better path of each window, chosen afterwards | 20.0 % | 480 ms | 2.0 s |" in drives
    assert "| `plr-replicate` | 1.0 % | 119 ms | 100 ms | 200 |" in drives
    assert "is 4.03 times lower than that of the better direct run, its P99 20 times" in drives
    assert "zenoh" not in drives, "who did not run has no row"
    assert "multipath TCP | 1 | 3.0 % | 157 ms | 2.0 s | 150 | 1.0 % | 119 ms | 100 ms | 200 |" in blocks["others"]
    assert "| `adaptive` | 1 | 3.0 % | 89 % | 20 % |" in blocks["modes"]
    assert "| `mean_gain` | 4.03 | ≥ 1.9 | met |" in blocks["verdicts"]
    assert "| `fallback_late` | not measured | ≤ 0 | not measured |" in blocks["verdicts"]
    assert "| driving, mean | 2.73, 1.9 | 7.23, 4.03 | 1 |" in blocks["paper"]
    assert "| a-recorded, plr-replicate: mean gain | 4.03 | 3.48 | 14 % |" in blocks["reproduced"]
    assert blocks["budgets"] == blocks["fallback"] == NOTHING


def test_other_cases_have_a_table_of_their_own() -> None:
    late = {"direct-a": 60, "direct-b": 40, "plr-replicate": 2, "ideal": 1}
    wifi = [run(name, scenario=f"two-wifi-{n}", case="C", late=count) for n in (1, 2) for name, count in late.items()]
    table = all_blocks(content(*evaluation(), *wifi))["cases"]
    assert (
        "| C: two Wi-Fi, two-wifi | 2 | ROS 2 over the better path of each window, chosen afterwards | 40.0 %" in table
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
        archive.extractall(tmp_path, filter="data")
    assert content(*read_records(tmp_path)) == content(*evaluation())
    assert pack(read_records(tmp_path), RUNS) == pack(reversed(evaluation()), RUNS)
