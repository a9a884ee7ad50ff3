"""Who is next of those that wait for room."""

from __future__ import annotations

from plr.sidecar.core.base.values import SHARE, Priority
from plr.sidecar.core.transfer.waiting_line import SLACK, WaitingLine


def order(line: WaitingLine[str], now: float) -> list[str]:
    found = []
    while (key := line.first(now)) is not None:
        line.went(key)
        found.append(key)
    assert len(line) == 0
    return found


def test_urgent_then_in_time_then_by_deadline_then_as_they_came() -> None:
    line: WaitingLine[str] = WaitingLine()
    for key, priority, deadline in (
        ("low", Priority.LOW, 2.0),
        ("late", Priority.NORMAL, 0.9),
        ("later", Priority.NORMAL, 0.5),
        ("second", Priority.NORMAL, 3.0),
        ("third", Priority.NORMAL, 3.0),
        ("first", Priority.NORMAL, 2.0),
        ("high", Priority.HIGH, 9.0),
    ):
        line.add(key, priority, deadline, 1000)
    assert order(line, 1.0) == ["high", "first", "second", "third", "later", "late", "low"]


def test_a_lower_priority_gets_its_share() -> None:
    line: WaitingLine[str] = WaitingLine()
    line.add("low", Priority.LOW, 1.0, 3000)
    for number in range(4 * SHARE):
        line.add(f"high {number}", Priority.HIGH, 1.0, 1000)
    assert order(line, 0.0).index("low") == 3 * SHARE


def test_who_leaves_or_comes_back_has_one_place_and_leaves_none_behind() -> None:
    line: WaitingLine[str] = WaitingLine()
    for number in range(10 * SLACK):
        line.add("one", Priority.NORMAL, float(number), 1)
        line.remove("one")
        line.remove("one")
    line.add("other", Priority.NORMAL, 5.0, 1)
    line.add("one", Priority.NORMAL, 7.0, 1)
    assert sum(len(each.fresh) + len(each.late) for each in line._classes) <= SLACK + 5
    assert order(line, 6.0) == ["one", "other"]
