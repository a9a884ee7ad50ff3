"""Who waits, whose turn it is, and who has to go: `Admission`."""

from __future__ import annotations

import pytest

from plr.controlplane.core.overload.admission import Admission


def admission(most_waiting: int = 100, most_on_the_way: int = 2) -> Admission[str]:
    return Admission(most_waiting=most_waiting, most_on_the_way=most_on_the_way, stranger_s=1.0, member_s=5.0)


@pytest.mark.audit("ops-16")
def test_the_newest_of_each_source_goes_first_and_the_sources_in_turn() -> None:
    gate = admission(most_on_the_way=9)
    for item, source in (("a1", "a"), ("a2", "a"), ("a3", "a"), ("b1", "b"), ("c1", "c"), ("c2", "c")):
        assert gate.wait(item, source) is None
    assert [gate.next(0.0) for _ in range(7)] == ["a3", "b1", "c2", "a2", "c1", "a1", None]


@pytest.mark.audit("ops-16")
def test_no_more_are_on_the_way_than_may_be_and_strangers_count_for_a_second() -> None:
    gate = admission()
    for item in "abcdef":
        gate.wait(item, "x")
    assert [gate.next(0.0) for _ in range(3)] == ["f", "e", None]
    assert gate.next_at() == 1.0
    gate.proven("f", "robot-1", 0.5)
    assert [gate.next(1.0) for _ in range(2)] == ["d", None]  # the stranger's place
    assert gate.over("d")
    assert not gate.over("d")
    assert [gate.next(1.5) for _ in range(2)] == ["c", None]
    assert not gate.over("e")
    assert gate.next_at() == 2.5
    assert gate.over("f", "robot-1")
    assert gate.next(1.6) == "b"


@pytest.mark.audit("ops-16")
def test_a_member_takes_one_place_however_many_connections_it_opens() -> None:
    gate = admission()
    for item in "abcd":
        gate.wait(item, "x")
    for _ in range(4):
        turn = gate.next(0.0)
        assert turn is not None
        gate.proven(turn, "robot-1", 0.0)
    assert gate.on_the_way == 1
    assert not gate.over("d", "robot-1")  # another took its place
    assert gate.over("a", "robot-1")


@pytest.mark.audit("ops-16")
def test_the_source_with_the_longest_line_loses_its_oldest() -> None:
    gate = admission(most_waiting=5)
    for item, source in (("b1", "b"), ("a1", "a"), ("a2", "a"), ("a3", "a"), ("c1", "c")):
        assert gate.wait(item, source) is None
    assert gate.wait("a4", "a") == "a1"
    assert gate.wait("d1", "d") == "a2"
    assert gate.wait("c2", "c") in {"a3", "c1"}
    assert len(gate) == 5


@pytest.mark.audit("ops-16")
def test_who_left_is_not_served_and_leaves_nothing_behind() -> None:
    gate = admission()
    for number in range(50):
        gate.wait(f"{number}", f"source-{number % 7}")
    for number in range(50):
        gate.leave(f"{number}")
        gate.leave(f"{number}")
    assert gate.next(0.0) is None
    assert gate.next_at() is None
    assert (len(gate), gate._sources, gate._by_length, gate._longest) == (0, {}, {}, 0)
