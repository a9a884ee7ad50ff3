from __future__ import annotations

from typing import TYPE_CHECKING

from plr.sidecar.core.base.timers import NEVER
from plr.sidecar.core.path.spare_time import SpareTime
from plr.sidecar.core.path.turn import SharedTurn
from tests.support.builders import message

if TYPE_CHECKING:
    from plr.sidecar.core.path.turn import Turn

RTT_S = 0.02


def turn(number: int, deadline: float = 5.0, *, taken: bool = True, size: int = 12_000) -> SharedTurn:
    """Of a message that another path carries: all of it, or nothing yet."""
    outbound = message(number, size, deadline=deadline, expires=9.0, repeats=1.0)
    assert outbound.sharing is not None
    outbound.sharing.join(object())
    if taken:
        outbound.sharing.take_all()
    return SharedTurn(outbound, outbound.sharing, repeats=True)


def spare_time(*turns: SharedTurn) -> tuple[SpareTime, dict[int, Turn]]:
    entries: dict[int, Turn] = {each.message.number: each for each in turns}
    line = SpareTime(entries)
    for each in turns:
        line.add(each)
    return line, entries


def numbers(line: SpareTime, now: float = 0.0) -> list[int]:
    found = []
    while (run := line.take(now, 1_000_000, RTT_S)) is not None:
        found.append(run.message.number)
    return found


def test_the_earliest_deadline_that_can_still_be_kept_goes_first_and_the_late_last() -> None:
    line, entries = spare_time(turn(1, 8.0), turn(2, 1.01), turn(3, 6.0))
    assert numbers(line, now=1.0) == [3, 1, 2]
    assert entries == {}, "nothing more of them leaves here"


def test_the_expired_and_the_answered_are_not_repeated() -> None:
    answered = turn(1)
    line, entries = spare_time(answered, turn(2))
    answered.message.over = True
    assert numbers(line, now=9.0) == []
    assert entries == {}


def test_what_was_removed_is_not_repeated_and_may_come_back() -> None:
    one = turn(1)
    line, _ = spare_time(one)
    assert line.remove(1)
    assert not line.remove(1)
    line.add(one)
    assert numbers(line) == [1]


def test_what_is_left_to_others_is_looked_at_again() -> None:
    declined = turn(1, taken=False)
    line, _ = spare_time()
    line.add(declined, look_at=1.0)
    assert line.next_look == 1.0
    assert list(line.due(0.9)) == []
    assert list(line.due(1.0)) == [declined]
    assert line.next_look == NEVER


def test_what_others_took_meanwhile_ends_here_once_it_is_repeated() -> None:
    declined = turn(1, taken=False)
    line, entries = spare_time(declined)
    line.add(declined, look_at=1.0)
    assert numbers(line) == [1], "repeated in spare time although some is untaken"
    assert list(entries) == [1]
    assert declined.message.sharing is not None
    declined.message.sharing.take_all()
    assert list(line.due(1.0)) == []
    assert numbers(line) == []
    assert entries == {}


def test_looking_again_and_again_keeps_no_more_in_memory() -> None:
    declined = turn(1, taken=False)
    line, _ = spare_time()
    line.add(declined, look_at=0.0)
    for step in range(1000):
        for each in line.due(float(step)):
            line.add(each, look_at=step + 1.0)
    assert len(line._repeatable) + len(line._declined) <= 2


def test_purging_forgets_what_is_over() -> None:
    over, alive = turn(1), turn(2)
    line, _ = spare_time(over, alive)
    over.message.over = True
    line.purge({over.message.number})
    assert [entry for *_, entry in line._repeatable] == [alive]
    line.clear()
    assert numbers(line) == []
