"""An evaluation works end to end: a contender replays a window in the lab. How good it is, is not asked here."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

import pytest

from bench import __main__ as bench
from bench.evaluation.outcome import Outcome

if TYPE_CHECKING:
    from pathlib import Path

pytestmark = [pytest.mark.netns, pytest.mark.ros, pytest.mark.timeout(120)]


def test_ros_over_one_carrier_replays_a_window_beside_the_ideal(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    contenders = ("ideal", "direct-b")
    arguments = ["bench", "evaluate", "--quick", "--scenario", "blind-spot-1", "--seconds", "2", "--out", str(tmp_path)]
    monkeypatch.setattr("sys.argv", [*arguments, *(f"--contender={name}" for name in contenders)])
    assert bench.main() == 0
    report = json.loads((tmp_path / "evaluation.json").read_text())
    assert report["failed"] == []
    assert set(report["runs"]["blind-spot-1-2s"]) == set(contenders)
    outcome = Outcome.read(tmp_path / "evaluation" / "blind-spot-1-2s" / "direct-b.json")
    assert [request.due_s for request in outcome.requests] == pytest.approx([number / 5 for number in range(10)])
    assert any(request.answered_s is not None for request in outcome.requests)
    assert outcome.bytes_sent["wwan0"] > 10 * 120_000
    assert set(outcome.bytes_sent) == {"wwan0"}
