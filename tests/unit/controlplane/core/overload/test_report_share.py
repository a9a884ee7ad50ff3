"""Many members who send all that they may do not take the whole loop; those with ordinary reports notice nothing."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import pytest

from plr.controlplane.core.base import member_table
from plr.controlplane.core.overload.report_share import (
    BUSY,
    ENTRIES_BURST,
    ENTRIES_PER_S,
    LEAST_BURST,
    LEAST_ENTRIES_PER_S,
    ReportShares,
    level,
)
from plr.protos.convert.fields import MAX_OUTCOMES
from plr.protos.model.ids import NodeName
from plr.protos.model.report import MAX_GOODBYES, MAX_JOINTS, MAX_LATENCIES, MAX_PATH_REPORTS, MAX_PENALTIES

ROBOT = NodeName("robot")
ENTRY_S = 40e-6
"""Of one core."""
TICK_S = 0.1


@dataclass
class Member:
    entries: int
    """Of each of its reports."""
    interval_s: float
    next_at: float = 0.0
    taken: int = 0
    late_s: float = 0.0


@dataclass
class Fleet:
    """A loop that reads reports, `other` share of it taken by something else; it looks at its load once a second."""

    members: list[Member]
    other: float = 0.0
    shares: ReportShares = field(default_factory=ReportShares)
    now: float = 0.0
    busy: list[float] = field(default_factory=list)
    _used: float = 0.0
    _first: int = 0

    def run(self, seconds: float) -> None:
        for tick in range(round(seconds / TICK_S)):
            left_s = TICK_S * (1.0 - self.other)
            # Who waits in gRPC takes turns.
            self._first = (self._first + 1) % len(self.members)
            for number in (*range(self._first, len(self.members)), *range(self._first)):
                member, name = self.members[number], NodeName(f"m{number}")
                if left_s <= 0.0 or member.next_at > self.now:
                    continue
                if self.shares.wait_s(name, self.now):
                    member.late_s = max(member.late_s, self.now - member.next_at)
                    continue
                self.shares.take(name, member.entries, self.now)
                member.taken += member.entries
                member.next_at = max(member.next_at, self.now - TICK_S) + member.interval_s
                left_s -= member.entries * ENTRY_S
            self._used += TICK_S - max(left_s, 0.0)
            self.now += TICK_S
            if tick % 10 == 9:
                self.shares.follow(self._used / 1.0, self.now)
                self.busy.append(self._used)
                self._used = 0.0

    def forget_what_was(self) -> None:
        for member in self.members:
            member.taken, member.late_s = 0, 0.0
        self.busy.clear()


def test_many_hostile_members_leave_room_and_honest_ones_notice_nothing() -> None:
    honest = [Member(50, 6.3, next_at=number * 0.05) for number in range(120)]
    hostile = [Member(1600, 0.01) for _ in range(60)]
    fleet = Fleet([*honest, *hostile])
    fleet.run(30.0)
    assert max(member.late_s for member in honest) < 1.0, "not while the level is looked for either"
    fleet.forget_what_was()
    fleet.run(30.0)
    assert sum(fleet.busy) / len(fleet.busy) < 0.95, "60 times 2000 entries would take five cores"
    assert max(member.late_s for member in honest) == 0.0
    each = [member.taken / 30.0 for member in hostile]
    assert max(each) < 3.0 * min(each), "those who send most are held at one level"
    assert sum(each) > LEAST_ENTRIES_PER_S / 2, "and are read as far as there is room"


def test_a_loop_that_is_busy_with_something_else_slows_no_ordinary_reports() -> None:
    fleet = Fleet([Member(50, 2.0, next_at=number * 0.01) for number in range(200)], other=0.7)
    fleet.run(30.0)
    assert max(fleet.busy) > BUSY
    assert fleet.shares.slowed == 0


def test_when_the_load_is_over_everybody_is_read_as_fast_as_before() -> None:
    fleet = Fleet([Member(1600, 0.01) for _ in range(60)])
    fleet.run(20.0)
    assert fleet.shares.entries_per_s < ENTRIES_PER_S / 2
    for second in range(60):
        fleet.shares.follow(0.1, fleet.now + second)
    assert fleet.shares.entries_per_s == ENTRIES_PER_S


@pytest.mark.parametrize(
    ("rates", "room", "expected"),
    [
        ([], 1.0, math.inf),
        ([1.0, 2.0], 3.0, math.inf),
        ([1.0, 10.0], 5.0, 4.0),
        ([10.0, 1.0, 10.0], 11.0, 5.0),
        ([4.0] * 4, 8.0, 2.0),
    ],
)
def test_the_level_cuts_the_highest_alone(rates: list[float], room: float, expected: float) -> None:
    assert level(rates, room) == expected


@pytest.mark.audit("ops-20")
def test_reports_of_a_large_robot_are_read_at_once_and_of_more_at_a_bearable_pace() -> None:
    shares = ReportShares()
    large = 8 * 16 * (4 + 1)
    assert not any(shares.take(ROBOT, large, second / 2) for second in range(100)), "8 interfaces, 16 servers"
    largest = MAX_LATENCIES + MAX_PATH_REPORTS + MAX_OUTCOMES + 2 * MAX_JOINTS + MAX_PENALTIES + MAX_GOODBYES
    assert not shares.take(ROBOT, largest, 60.0), "the largest there is"
    now, entries = 100.0, 0
    while now < 200.0:
        now += shares.wait_s(ROBOT, now) + 0.01
        shares.take(ROBOT, 1600, now)
        entries += 1600
    assert entries <= ENTRIES_BURST + 100.0 * ENTRIES_PER_S + 2 * 1600
    assert shares.slowed


def test_who_connects_again_and_again_has_one_share(monkeypatch: pytest.MonkeyPatch) -> None:
    """It is the member's, not the stream's; and those of others do not take it away."""
    monkeypatch.setattr(member_table, "MAX_MEMBERS", 3)
    shares = ReportShares()
    assert shares.take(ROBOT, int(ENTRIES_BURST) + 2000, 0.0)
    shares.take(NodeName("b"), 1, 0.0)
    shares.take(NodeName("c"), 1, 0.0)
    assert shares.wait_s(ROBOT, 0.5) == pytest.approx(0.5)
    shares.take(ROBOT, 0, 0.5)
    shares.take(NodeName("d"), 1, 0.5)
    assert shares.wait_s(ROBOT, 0.5) == pytest.approx(0.5), "who reported longest ago is forgotten"
    assert shares.wait_s(NodeName("b"), 0.5) == 0.0
    assert shares.members.forgotten == 1
    assert LEAST_BURST < ENTRIES_BURST
