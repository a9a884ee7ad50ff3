"""Which recorded windows are one drive, and what an oracle gets of both paths."""

from __future__ import annotations

import gzip
import json
from typing import TYPE_CHECKING

import pytest

from bench.evaluation import ideal, oracle
from bench.evaluation.drives import find, shared_steps, together
from bench.evaluation.scenario import read_scenarios
from lab.trace_folder import read_folder
from plr.controlplane.planning.traces import COLUMNS

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

pytestmark = pytest.mark.audit("ops-21")

LENGTH_S = 200


def record(folder: Path, name: str, networks: str, *rates: Callable[[int], float], begin: int = 0) -> dict[str, object]:
    """A trace of two networks whose rates are functions of the recording's clock; returns its entry."""
    rows = [",".join(COLUMNS)]
    for second in range(LENGTH_S):
        cells = [f"{kbps(begin + second):g},{kbps(begin + second):g},40,0" for kbps in rates]
        rows.append(f"{second},{','.join(cells)}")
    (folder / f"{name}.csv.gz").write_bytes(gzip.compress("\n".join(rows).encode()))
    return {"name": name, "kind": "rate", "a": networks[0], "b": networks[1], "duration_s": LENGTH_S}


def network(seed: int) -> Callable[[int], float]:
    return lambda second: 1000.0 + (second * 7919 * seed) % 9973


def test_windows_that_replay_the_same_seconds_of_a_network_are_one_drive(tmp_path: Path) -> None:
    one, two, three, other = map(network, (1, 2, 3, 5))
    entries = [
        record(tmp_path, "drive-p-q-01", "PQ", one, two),
        record(tmp_path, "drive-p-r-01", "PR", one, three, begin=20),  # 20 s later: 100 s of the window are the same
        record(tmp_path, "drive-q-r-01", "QR", two, three, begin=130),  # the same recordings, other seconds
        record(tmp_path, "drive-q-r-02", "QR", other, network(7)),
    ]
    (tmp_path / "index.json").write_text(json.dumps(entries))
    found = find(read_scenarios(read_folder(tmp_path)))
    assert found.distinct == (
        ("a-drive-p-q-01-at-40", "a-drive-p-r-01-at-40"),
        ("a-drive-q-r-01-at-40",),
        ("a-drive-q-r-02-at-40",),
    )
    assert found.recordings == 2, "the third trace is another stretch of the first two' recording"


def test_outages_alone_make_no_drive() -> None:
    assert shared_steps([0.0] * 60 + [1.0, 2.0], [0.0] * 60 + [3.0, 4.0], 30) == 0
    assert shared_steps([9.0, 1.0, 2.0, 3.0], [1.0, 2.0, 3.0, 8.0], 3) == 3
    assert shared_steps([9.0, 1.0, 2.0, 3.0], [1.0, 2.0, 3.0, 8.0], 4) == 0


def test_likeness_is_handed_on() -> None:
    assert together(list("abcd"), lambda one, other: {one, other} in ({"a", "c"}, {"c", "d"})) == (
        ("a", "c", "d"),
        ("b",),
    )


def test_the_oracle_shares_out_what_neither_path_bears_alone(tmp_path: Path) -> None:
    """Five requests of 120 kB a second take 5 Mbit/s; each of two paths of 3 Mbit/s fills up under copies of all."""
    slow = [record(tmp_path, "drive-p-q-01", "PQ", lambda _: 3000.0, lambda _: 3000.0)]
    (tmp_path / "index.json").write_text(json.dumps(slow))
    scenario = next(one for one in read_scenarios(read_folder(tmp_path)) if one.window is not None)
    assert ideal.compute(scenario, "ideal").figures().miss_ratio > 0.9
    shared = oracle.compute(scenario)
    assert shared.figures().miss_ratio == 0.0
    assert shared == oracle.compute(scenario)


def test_the_oracle_sends_nothing_that_would_be_late_and_is_late_with_nothing(tmp_path: Path) -> None:
    dark = [record(tmp_path, "drive-p-q-01", "PQ", *(2 * [lambda second: 0.0 if 90 <= second < 100 else 20_000.0]))]
    (tmp_path / "index.json").write_text(json.dumps(dark))
    scenario = next(one for one in read_scenarios(read_folder(tmp_path)) if one.window is not None)
    requests = oracle.compute(scenario).requests
    missed = [one.due_s for one in requests if one.answered_s is None]
    assert 0 < len(missed) <= 10 * 5, "the queue of the dark seconds costs nobody after them"
    assert all(49.0 <= due_s < 60.0 for due_s in missed), "the window begins at 40 s"
    assert all(one.answered_s - one.due_s <= 1.0 for one in requests if one.answered_s is not None)
