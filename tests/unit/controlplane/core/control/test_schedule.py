"""When it is time to solve."""

from __future__ import annotations

import pytest

from plr.controlplane.core.control.schedule import (
    ROBOTS_TIMES,
    ROBOTS_WAIT_S,
    ROUTINE_INTERVAL_S,
    ROUTINE_TIMES,
    URGENT_DELAY_S,
    Change,
    Debounce,
)


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


@pytest.mark.audit("ops-16")
@pytest.mark.parametrize("took_s", [0.0, 0.02, 0.25, 3.0])
def test_robots_that_come_leave_time_for_the_rest(took_s: float) -> None:
    debounce, now, solved, wait = Debounce(), 0.0, 0, 0.0
    while solved < 20:
        debounce.note(Change.ROBOTS, now)
        due = debounce.next_time()
        assert due is not None
        wait = due - now
        now = due
        assert debounce.start(now) is Change.ROBOTS
        now += took_s
        debounce.finished(now)
        solved += 1
    assert wait == pytest.approx(max(URGENT_DELAY_S, min(ROBOTS_TIMES * took_s, ROBOTS_WAIT_S)))


@pytest.mark.audit("ops-20")
@pytest.mark.parametrize("change", [Change.PATH, Change.MISSES, Change.MEMBERS])
def test_what_is_urgent_waits_for_no_robots(change: Change) -> None:
    debounce = Debounce()
    debounce.note(Change.ROBOTS, 0.0)
    solve_at(debounce, URGENT_DELAY_S, duration=0.5)
    debounce.note(Change.ROBOTS, 0.6)
    debounce.note(change, 0.7)
    assert debounce.next_time() == pytest.approx(0.7 + URGENT_DELAY_S)
    solve_at(debounce, 0.7 + URGENT_DELAY_S)
    assert debounce.next_time() is None
