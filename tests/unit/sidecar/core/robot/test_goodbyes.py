"""Servers that said goodbye."""

from __future__ import annotations

import pytest

from plr.protos.model.ids import NodeName, SessionId
from plr.protos.model.report import MAX_GOODBYES
from plr.sidecar.core.robot.goodbyes import Goodbyes

pytestmark = pytest.mark.audit("ops-11")


def test_no_more_are_reported_than_a_report_holds_and_the_oldest_goes() -> None:
    goodbyes = Goodbyes()
    names = [NodeName(f"cloud-{number}") for number in range(MAX_GOODBYES + 1)]
    for name in (*names[:-1], names[0], names[-1]):
        goodbyes.note(name, SessionId(1))
    assert goodbyes.report() == (*names[2:-1], names[0], names[-1])
