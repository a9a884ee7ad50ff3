"""A short `make bench-insiders`: two members attack all others in every way at once, and no honest request is lost."""

from __future__ import annotations

import io
from typing import TYPE_CHECKING

import pytest
from rich.console import Console

from bench.insiders.command import insiders
from bench.insiders.report import show
from lab.attacker.hostile_link import ATTACKS

if TYPE_CHECKING:
    from pathlib import Path

pytestmark = [pytest.mark.netns, pytest.mark.busy, pytest.mark.ros, pytest.mark.timeout(400)]

ATTACK_S, QUIET_S, CYCLE_S = 22.0, 2.0, 15.0
IN_EVERY_RUN = {
    "false reports",
    "requests that are CDR bombs",
    "silent connections",
    "registrations under another's name",
    "256 addresses of a third party",
}


def test_nothing_is_lost_while_insiders_do_everything(tmp_path: Path) -> None:
    said = io.StringIO()
    console = Console(file=said, width=200)
    outcome = insiders(console, tmp_path, ATTACK_S, QUIET_S, cycle_s=CYCLE_S)
    show(console, outcome)
    assert outcome.requests_verdicts() == [], said.getvalue()
    assert outcome.third_party_bytes <= outcome.third_party_limit()
    attacks = outcome.attacks()
    missing = (IN_EVERY_RUN | {attack.name for attack in ATTACKS}) - attacks.keys()
    assert not missing, said.getvalue()
