"""The measurement of the data plane works end to end; how fast anything is, is not asked here."""

from __future__ import annotations

import json
import time
from typing import TYPE_CHECKING

import pytest

from bench import __main__ as bench
from bench.dataplane.ours import Ours
from bench.dataplane.topology import CARRIERS, SilentCut, cables
from lab import Lab

if TYPE_CHECKING:
    from pathlib import Path

pytestmark = [pytest.mark.netns, pytest.mark.timeout(120)]


def test_a_section_writes_figures_verdicts_and_a_page(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    arguments = ["bench", "dataplane", "--quick", "--only", "one_way", "--out", str(tmp_path)]
    monkeypatch.setattr("sys.argv", arguments)
    assert bench.main() == 0
    content = json.loads((tmp_path / "dataplane.json").read_text())
    for contender in ("engine", "aioquic", "udp"):
        assert content[f"{contender}_1k_ms"] > 0
        assert content[f"{contender}_150k_ms"] > 0
    assert content["engine_150k_over_aioquic"] > 0
    assert isinstance(content["verdicts"]["engine_150k_over_aioquic"], bool)
    assert content["verdicts"]["blackhole_lost"] is None
    assert "One-way time on loopback" in (tmp_path / "dataplane.html").read_text()


def test_the_engine_answers_over_cables_while_one_is_silent_and_after_it(tmp_path: Path) -> None:
    with (
        Lab(cables()) as lab,
        Ours.in_lab(lab, tmp_path) as ours,
    ):
        cut = SilentCut(lab)
        ours.begin(size=1000, count=60, rate_hz=30.0)
        time.sleep(0.5)
        cut.cut(CARRIERS[0])
        calls = ours.finish()
        assert calls.row("cut").lost == 0
        cut.mend()
        cut.cut(*CARRIERS)
        assert ours.call(size=1000, count=3, rate_hz=10.0, grace_s=0.1).row("dark").lost == 3
        cut.mend()
