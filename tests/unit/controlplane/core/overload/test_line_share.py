from __future__ import annotations

import pytest

from plr.controlplane.core.base import member_table
from plr.controlplane.core.overload.line_share import LINES_BURST, LINES_PER_S, LineShare
from plr.protos.base.token_bucket import TokenBucket


@pytest.mark.audit("ops-16")
def test_one_that_registers_every_second_fills_no_log_and_is_counted() -> None:
    lines = LineShare()
    day_s = 86_400
    told = [left_out for second in range(day_s) if (left_out := lines.take("robot", float(second))) is not None]
    assert len(told) <= LINES_BURST + day_s * LINES_PER_S + 1
    assert len(told) + lines.left_out == day_s
    assert lines.left_out - 1 / LINES_PER_S <= sum(told) <= lines.left_out
    assert told[int(LINES_BURST) + 1] == pytest.approx(1.0 / LINES_PER_S, abs=2.0), "the line says how many"
    assert lines.take("another", float(day_s)) == 0


def test_the_table_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(member_table, "MAX_MEMBERS", 2)
    lines = LineShare()
    for _ in range(int(LINES_BURST) + 1):
        lines.take("a", 0.0)
    assert lines.take("a", 0.0) is None
    lines.take("b", 0.0)
    lines.take("c", 0.0)
    assert lines.take("a", 0.0) == 0, "forgotten, and counted from zero"
    assert lines.shares.forgotten == 2


@pytest.mark.audit("ops-16")
def test_what_one_leaves_of_the_lines_of_all_is_for_the_others_and_what_all_lack_is_counted() -> None:
    lines = LineShare()
    of_all = TokenBucket(rate=1.0, burst=LINES_BURST + 1.0, now=0.0)
    for _ in range(200):
        lines.take("evil", 0.0, of_all)
    assert lines.left_out == 200 - LINES_BURST
    assert lines.take("robot", 0.0, of_all) == 0
    assert lines.take("robot", 0.0, of_all) is None, "there are too many of all"
    assert lines.left_out == 201 - LINES_BURST
    assert lines.take("robot", 1.0, of_all) == 1, "it says how many"
