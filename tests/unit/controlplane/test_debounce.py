"""When it is time to solve."""

from __future__ import annotations

import pytest

from controlplane.core.debounce import ROUTINE_INTERVAL_S, ROUTINE_TIMES, URGENT_DELAY_S, Change, Debounce


def solve_at(debounce: Debounce, now: float, duration: float = 0.0) -> None:
    assert debounce.start(now)
    debounce.finished(now + duration)


def test_without_a_change_there_is_nothing_to_solve() -> None:
    debounce = Debounce()
    assert debounce.next_time() is None
    assert not debounce.start(1e9)


def test_a_path_that_dies_is_solved_for_at_once() -> None:
    debounce = Debounce()
    debounce.note(Change.REPORT, 10.0)
    solve_at(debounce, 10.0)
    debounce.note(Change.PATH, 10.1)
    assert debounce.next_time() == pytest.approx(10.1 + URGENT_DELAY_S)
    debounce.note(Change.PATH, 10.12)
    assert not debounce.start(10.1 + URGENT_DELAY_S / 2)
    solve_at(debounce, 10.1 + URGENT_DELAY_S)
    assert debounce.next_time() is None


def test_reports_alone_are_solved_for_once_in_an_interval() -> None:
    debounce = Debounce()
    starts = []
    for step in range(1000):
        now = step * 0.01
        debounce.note(Change.REPORT, now)
        if debounce.start(now):
            starts.append(now)
            debounce.finished(now)
    assert starts == pytest.approx([k * ROUTINE_INTERVAL_S for k in range(10)])


def test_a_large_fleet_is_solved_less_often() -> None:
    debounce = Debounce()
    debounce.note(Change.REPORT, 0.0)
    solve_at(debounce, 0.0, duration=3.0)
    debounce.note(Change.REPORT, 3.0)
    assert debounce.next_time() == ROUTINE_TIMES * 3.0
    debounce.note(Change.MEMBERS, 3.0)
    assert debounce.next_time() == pytest.approx(3.0 + URGENT_DELAY_S)


def test_what_happens_while_solving_is_solved_for_afterwards() -> None:
    debounce = Debounce()
    debounce.note(Change.PATH, 0.0)
    assert debounce.start(URGENT_DELAY_S)
    debounce.note(Change.PATH, 0.1)
    assert debounce.next_time() is None
    assert not debounce.start(5.0)
    debounce.finished(5.0)
    assert debounce.start(5.0)
