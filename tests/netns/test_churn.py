"""A short `make bench-churn`: whatever comes and goes, no request is lost while a path and a server are well."""

from __future__ import annotations

import io
from typing import TYPE_CHECKING

import pytest
from rich.console import Console

from bench.churn.command import churn

if TYPE_CHECKING:
    from pathlib import Path

pytestmark = [pytest.mark.netns, pytest.mark.ros, pytest.mark.timeout(300)]

LENGTH_S = 50.0


def test_nothing_is_lost_nor_doubled_while_everything_comes_and_goes(tmp_path: Path) -> None:
    said = io.StringIO()
    outcome = churn(Console(file=said, width=200), tmp_path, LENGTH_S, seed=2)
    assert outcome.verdicts() == [], said.getvalue()
    assert len(outcome.done) >= 5
    assert {done.trouble.lane for done in outcome.done} >= {"paths", "servers"}
