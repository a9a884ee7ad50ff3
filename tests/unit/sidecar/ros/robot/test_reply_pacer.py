"""Answers to one client never overflow a queue of 10 that is emptied once a millisecond."""

from __future__ import annotations

import random

from hypothesis import given
from hypothesis import strategies as st

from plr.sidecar.ros.robot.reply_pacer import BURST_ANSWERS, LATE_COST, MAX_CLIENTS, SPACING_S, ReplyPacer

A, B = b"a" * 16, b"b" * 16


def test_a_few_at_once_and_the_rest_spaced() -> None:
    pacer: ReplyPacer[int] = ReplyPacer()
    sent = [number for number in range(20) if pacer.admit(A, number, 1.0, late=False)]
    assert sent == list(range(BURST_ANSWERS))
    assert pacer.queued == 12
    assert pacer.take_due(1.0) == []
    due = pacer.next_due()
    assert due is not None
    assert abs(due - (1.0 + SPACING_S)) < 1e-9
    assert pacer.take_due(1.0 + 2.5 * SPACING_S) == [8, 9]
    assert pacer.take_due(2.0) == list(range(10, 18))
    assert pacer.take_due(3.0) == [18, 19]
    assert pacer.queued == 0
    assert pacer.next_due() is None


def test_an_answer_never_overtakes_a_waiting_one() -> None:
    pacer: ReplyPacer[int] = ReplyPacer(burst=1)
    assert pacer.admit(A, 0, 0.0, late=False)
    assert not pacer.admit(A, 1, 0.0, late=False)
    assert not pacer.admit(A, 2, 0.01, late=False)  # there is an allowance again, but 1 waits for it
    assert pacer.take_due(0.01) == [1]
    assert pacer.take_due(0.02) == [2]


def test_an_answer_in_time_goes_before_late_ones_that_wait() -> None:
    pacer: ReplyPacer[str] = ReplyPacer(burst=1)
    assert pacer.admit(A, "late 0", 0.0, late=True)
    assert not pacer.admit(A, "late 1", 0.0, late=True)
    assert not pacer.admit(A, "late 2", 0.0, late=True)
    assert not pacer.admit(A, "in time", 0.0, late=False)
    assert pacer.take_due(0.01) == ["in time"]
    assert pacer.admit(A, "in time, with an allowance", 0.02, late=False)
    assert pacer.take_due(0.02) == []
    assert pacer.take_due(0.03) == ["late 1"]
    assert pacer.take_due(0.04) == ["late 2"]
    assert pacer.next_due() is None


def test_late_answers_are_spaced_wider_and_leave_room_for_one_in_time() -> None:
    pacer: ReplyPacer[int] = ReplyPacer()
    now, sent = 10.0, [number for number in range(40) if pacer.admit(A, number, 10.0, late=True)]
    assert sent == [0]
    while pacer.queued:
        due = pacer.next_due()
        assert due is not None
        assert due > now
        now = due
        sent += pacer.take_due(now)
        assert sent == list(range(len(sent)))
    wanted_s = 39 * LATE_COST * SPACING_S - (BURST_ANSWERS - LATE_COST) * SPACING_S
    assert abs(now - 10.0 - wanted_s) < 1e-6
    pacer = ReplyPacer()
    assert pacer.admit(A, 0, 20.0, late=True)
    assert not pacer.admit(A, 1, 20.0, late=True)
    assert pacer.admit(A, 2, 20.0, late=False)


def test_one_request_after_the_other_is_never_held_back() -> None:
    pacer: ReplyPacer[int] = ReplyPacer()
    now = 0.0
    for number in range(1000):
        now += SPACING_S / 10
        pacer.request_taken(A, now)
        assert pacer.admit(A, number, now, late=False)


def test_clients_do_not_wait_for_each_other() -> None:
    pacer: ReplyPacer[int] = ReplyPacer()
    for number in range(20):
        pacer.admit(A, number, 0.0, late=False)
    assert all(pacer.admit(B, number, 0.0, late=False) for number in range(BURST_ANSWERS))


def test_clients_without_waiting_answers_are_forgotten() -> None:
    pacer: ReplyPacer[int] = ReplyPacer(burst=1)
    assert pacer.admit(A, 0, 0.0, late=False)
    assert not pacer.admit(A, 1, 0.0, late=False)
    for number in range(2 * MAX_CLIENTS):
        assert pacer.admit(number.to_bytes(16, "big"), 0, 0.0, late=False)
    assert len(pacer._clients) == MAX_CLIENTS
    assert pacer.take_due(1.0) == [1]


@given(
    seed=st.integers(0, 2**32),
    offered=st.lists(st.floats(0.0, 0.02), min_size=1, max_size=150),
    asked_earlier=st.booleans(),
)
def test_a_queue_of_ten_never_overflows(seed: int, offered: list[float], asked_earlier: bool) -> None:
    """Every answer is delivered, in order, and a client that takes one per spacing never has more than 10 unread."""
    rng = random.Random(seed)
    pacer: ReplyPacer[int] = ReplyPacer()
    for _ in offered if asked_earlier else ():
        pacer.request_taken(A, 0.0)
    deliveries: list[tuple[float, int]] = []
    now = 0.0

    def advance(to: float) -> None:
        nonlocal now
        while (due := pacer.next_due()) is not None and due <= to:
            now = max(now, due) + rng.random() * 1e-4
            deliveries.extend((now, reply) for reply in pacer.take_due(now))
        now = max(now, to)

    for number, at in enumerate(sorted(offered)):
        advance(at)
        if pacer.admit(A, number, now, late=False):
            deliveries.append((now, number))
    advance(now + 1.0)
    assert [reply for _, reply in deliveries] == list(range(len(offered)))
    unread, last = 0.0, 0.0
    for at, _ in deliveries:
        unread = max(0.0, unread - (at - last) / SPACING_S) + 1
        last = at
        assert unread <= 10
