from __future__ import annotations

import csv
import gzip
import random
from typing import TYPE_CHECKING

import pytest

from bench.drives.command import TRAFFIC
from bench.drives.windows import WINDOW_S, Half, windows
from lab.trace_folder import TraceEntry

if TYPE_CHECKING:
    from pathlib import Path

COLUMNS = ("t_s", *(f"{path}_{what}" for path in "ab" for what in ("up_kbps", "down_kbps", "rtt_ms", "loss")))


def write(folder: Path, name: str, networks: tuple[str, str], a: list[float], b: list[float]) -> TraceEntry:
    file = folder / f"{name}.csv.gz"
    with gzip.open(file, "wt", newline="") as out:
        rows = csv.writer(out)
        rows.writerow(COLUMNS)
        for at, (one, other) in enumerate(zip(a, b, strict=True)):
            rows.writerow((at, one / 4, one, 40, 0, other / 4, other, 60, 0))
    return TraceEntry(name, "rate", networks, float(len(a)), file)


def series(seed: int, seconds: int = 600) -> list[float]:
    rng = random.Random(seed)
    return [round(rng.uniform(1_000, 90_000), 1) for _ in range(seconds)]


@pytest.fixture
def traces(tmp_path: Path) -> list[TraceEntry]:
    """Two recordings: one of three networks, of which two traces came, and one of two networks."""
    one, two, three = series(1), series(2), series(3)
    return [
        write(tmp_path, "drive-x-y-01", ("X", "Y"), one, two),
        write(tmp_path, "drive-x-z-01", ("X", "Z"), one[5:], three[5:]),
        write(tmp_path, "drive-x-z-02", ("X", "Z"), series(4), series(5)),
        write(tmp_path, "drive-y-z-short", ("Y", "Z"), series(6, 60), series(7, 60)),
        write(tmp_path, "walk-x-y-01", ("X", "Y"), series(8), series(9)),
    ]


def test_traces_with_the_same_series_are_one_recording(traces: list[TraceEntry]) -> None:
    found = windows(traces, TRAFFIC)
    assert [(one.recording, one.half) for one in found] == [
        ("drive-x-y-01", Half.TUNED),
        ("drive-x-y-01", Half.TUNED),
        ("drive-x-z-02", Half.JUDGED),
    ]


def test_windows_of_a_recording_lie_at_different_times(traces: list[TraceEntry]) -> None:
    starts = [one.scenario.window.start_s for one in windows(traces, TRAFFIC) if one.scenario.window is not None]
    assert starts == [120, 356, 240]
    assert abs(starts[0] - starts[1]) >= WINDOW_S


def test_a_window_that_replays_the_same_seconds_is_left_out(tmp_path: Path) -> None:
    one, two, three = series(1, 200), series(2, 200), series(3, 200)
    found = windows(
        [
            write(tmp_path, "drive-x-y-01", ("X", "Y"), one, two),
            write(tmp_path, "drive-x-z-01", ("X", "Z"), one, three),
        ],
        TRAFFIC,
    )
    assert [one.scenario.name for one in found] == ["drive-x-y-01-at-20"]
