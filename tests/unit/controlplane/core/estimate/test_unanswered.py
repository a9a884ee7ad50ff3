"""Which servers answer nobody: by the word of several robots, where several call."""

from __future__ import annotations

import pytest

from plr.controlplane.core.estimate.unanswered import (
    LATELY_S,
    MAX_ANSWERED,
    MAX_WORDS_OF_ROBOT,
    REMEMBERED_S,
    Unanswered,
)
from plr.protos.base.histogram import MAX_COUNT, Histogram
from plr.protos.model.ids import NodeName
from tests.support.samples import PLAN, histogram, latency

pytestmark = pytest.mark.audit("ops-12")

SERVER = NodeName("cloud-a")
HONEST = [NodeName(f"robot-{number}") for number in range(3)]
LIAR = NodeName("liar")
ENOUGH = 5
"""The alert's."""


def says(
    rows: Unanswered, robot: NodeName, now: float, *, answered: int = 0, lost: int = 0, server: str = SERVER
) -> int:
    """Report; return what is known of the server then."""
    times = histogram(0.01, times=answered, lost=lost)
    rows.note(robot, [latency("wlan0", server, Histogram(), processing=times)], now)
    return rows.row(SERVER, PLAN, now)


def test_a_robot_alone_is_believed_at_once() -> None:
    rows = Unanswered()
    assert [says(rows, HONEST[0], float(now), lost=2) for now in range(3)] == [2, 4, 6]
    assert says(rows, HONEST[0], 3.0, answered=1) == 0


def test_one_that_says_that_it_gets_no_answer_accuses_no_server_that_answers_others() -> None:
    rows = Unanswered()
    told = []
    for tick in range(300):
        now = tick * 0.1
        told.append(says(rows, LIAR, now, lost=1000))
        if tick % 10 == 0:
            for robot in HONEST:
                says(rows, robot, now, answered=1)
            says(rows, HONEST[0], now, lost=1)
            says(rows, HONEST[0], now + 0.05, answered=1)
    assert max(told[1:]) < ENOUGH
    for robot in HONEST:
        says(rows, robot, 31.0, answered=1)
    for tick in range(100):
        # Nor one that takes all places of who got an answer, as it hopes.
        says(rows, LIAR, 31.0 + tick * 0.1, answered=1)
        assert says(rows, LIAR, 31.05 + tick * 0.1, lost=1000) < ENOUGH
    rows.forget(LIAR)
    assert rows.row(SERVER, PLAN, 1000.0) == 0


def test_one_that_claims_answers_hides_no_server_that_answers_nobody_else() -> None:
    rows = Unanswered()
    for robot in HONEST:
        says(rows, robot, 0.0, answered=1)
    told = []
    for tick in range(300):
        now = 1.0 + tick * 0.1
        says(rows, LIAR, now, answered=1)
        if tick % 10 == 0:
            for robot in HONEST[:2]:
                says(rows, robot, now, lost=1)
        told.append(says(rows, LIAR, now, answered=1))
    assert min(told[50:]) >= ENOUGH


def test_answers_to_two_end_the_row() -> None:
    rows = Unanswered()
    for robot in HONEST[:2]:
        says(rows, robot, 0.0, lost=9)
    assert rows.row(SERVER, PLAN, 0.0) == 18
    assert says(rows, HONEST[2], 1.0, answered=1) == 18, "two against one"
    assert says(rows, LIAR, 2.0, answered=1) == 0


def test_where_the_others_are_idle_one_is_believed_a_little_later() -> None:
    rows = Unanswered()
    for robot in HONEST[1:]:
        says(rows, robot, 0.0, answered=1)
    assert says(rows, HONEST[0], 1.0, lost=9) == 0
    assert says(rows, HONEST[0], LATELY_S + 0.5, lost=1) == 10
    assert rows.row(SERVER, PLAN, LATELY_S + 1.0 + REMEMBERED_S) == 0, "nobody has tried since"


def test_none_counts_for_more_than_all_others() -> None:
    rows = Unanswered()
    says(rows, LIAR, 0.0, lost=MAX_COUNT)
    assert says(rows, LIAR, 0.0, lost=MAX_COUNT) == MAX_COUNT, "a count has an end"
    assert says(rows, HONEST[0], 0.0, lost=1) == 2


def test_words_of_one_robot_are_bounded_and_push_out_no_other_robots() -> None:
    rows = Unanswered()
    says(rows, HONEST[0], 0.0, lost=7)
    for number in range(3 * MAX_WORDS_OF_ROBOT):
        says(rows, LIAR, 0.0, lost=1, server=f"cloud-{number}")
    assert rows.forgotten == 2 * MAX_WORDS_OF_ROBOT
    assert len(rows) == 1 + MAX_WORDS_OF_ROBOT
    assert rows.row(SERVER, PLAN, 0.0) == 7
    for number in range(2 * MAX_ANSWERED):
        says(rows, NodeName(f"other-{number}"), 0.0, answered=1)
    for number in range(2 * MAX_ANSWERED):
        rows.forget(NodeName(f"other-{number}"))
    for robot in (LIAR, HONEST[0]):
        rows.forget(robot)
    assert len(rows) == 0


def test_a_new_process_behind_it_has_no_row() -> None:
    rows = Unanswered()
    says(rows, HONEST[0], 0.0, lost=7)
    says(rows, HONEST[1], 0.0, answered=1)
    rows.begin(SERVER, [PLAN])
    assert len(rows) == 0
    assert says(rows, HONEST[0], 1.0, lost=1) == 1
