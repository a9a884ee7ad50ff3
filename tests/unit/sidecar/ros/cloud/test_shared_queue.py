"""Requests of several robots at one server: urgency decides most turns, and nobody takes all of them."""

from __future__ import annotations

import pytest

from plr.sidecar.core.base.values import Priority
from plr.sidecar.ros.cloud.request_window import RequestWindow
from plr.sidecar.ros.cloud.shared_queue import SHARED_ONE_IN, SharedQueue

SERVER_S = 0.0015
STEP_S = 0.0005
FLOOD_HZ = 1000.0
LASTS_S = 10.0


def test_a_robot_alone_is_served_by_priority_and_deadline() -> None:
    queue: SharedQueue[int] = SharedQueue()
    for number, (priority, deadline) in enumerate([(Priority.LOW, 1), (Priority.HIGH, 3), (Priority.HIGH, 2)] * 5):
        queue.add(number, "robot", priority, deadline, 10.0)
    order = []
    while (found := queue.take(0.0, 0.0, late_too=True)) is not None:
        order.append(found[0] % 3)
    assert order == [2] * 5 + [1] * 5 + [0] * 5


def test_one_turn_in_four_goes_round_the_robots() -> None:
    queue: SharedQueue[tuple[str, int]] = SharedQueue()
    for number in range(100):
        queue.add(("evil", number), "evil", Priority.HIGH, 1.0, 10.0)
    for robot in ("a", "b"):
        for number in range(10):
            queue.add((robot, number), robot, Priority.LOW, 5.0, 10.0)
    taken = [queue.take(0.0, 0.0, late_too=True) for _ in range(12 * SHARED_ONE_IN)]
    owners = [found[0][0] for found in taken if found is not None]
    assert owners.count("a") == owners.count("b") == 4
    assert len(queue) == 120 - len(owners)


def test_what_is_removed_or_taken_back_is_in_no_line() -> None:
    queue: SharedQueue[int] = SharedQueue()
    for number in range(6):
        queue.add(number, number % 2, Priority.NORMAL, 1.0, 10.0)
    queue.remove(0)
    assert 0 not in queue
    assert queue.take_all() == [1, 2, 3, 4, 5]
    assert queue.take(0.0, 0.0, late_too=True) is None
    queue.add(7, 0, Priority.NORMAL, 1.0, 10.0)
    assert queue.take(0.0, 0.0, late_too=True) == (7, False)


@pytest.mark.parametrize("priority", [Priority.HIGH, Priority.NORMAL])
def test_a_robot_that_asks_faster_than_the_server_answers_does_not_starve_another(priority: Priority) -> None:
    """Before: 0 of 201 answered while it called all of it urgent."""
    window: RequestWindow[tuple[str, float]] = RequestWindow()
    now = flood_at = honest_at = 0.0
    number, asked = 0, 0
    at_server: list[tuple[int, tuple[str, float]]] = []
    done_at = 0.0
    waited = []
    while now < LASTS_S:
        now += STEP_S
        if flood_at <= now:
            flood_at += 1 / FLOOD_HZ
            window.add(("evil", now), priority, now + 0.05, now + 30.0, now, robot="evil")
        if honest_at <= now:
            honest_at += 0.05
            asked += 1
            window.add(("honest", now), Priority.NORMAL, now + 0.5, now + 30.0, now, robot="honest")
        for request in window.release(now):
            number += 1
            window.sent(number, now)
            if not at_server:
                done_at = now + SERVER_S
            at_server.append((number, request))
        if at_server and done_at <= now:
            answered, (robot, since) = at_server.pop(0)
            window.answered(answered, now)
            done_at = now + SERVER_S
            if robot == "honest":
                waited.append(now - since)
    assert len(waited) >= asked - 2
    assert max(waited) < 0.05
