from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from plr.protos.model.ids import NodeName, ServiceName
from plr.sidecar.core.base.values import ExecutionId, Priority
from plr.sidecar.core.seam.application import AbandonExecution, CancelExecution, ExecuteRequest, WithdrawService
from plr.sidecar.ros.event_queue import EventQueue

if TYPE_CHECKING:
    from plr.sidecar.core.seam.application import ApplicationEvent

GREEDY, HONEST = NodeName("greedy"), NodeName("honest")
GONE = WithdrawService(ServiceName("/plan"), "its server is gone")


def asks(robot: NodeName, number: int) -> ExecuteRequest:
    return ExecuteRequest(ExecutionId(number), ServiceName("/plan"), "", b"", robot, Priority.NORMAL, 1.0, 1.0)


@pytest.mark.audit("sec-5")
def test_a_thousand_requests_of_one_robot_delay_anothers_by_one() -> None:
    queue = EventQueue()
    for number in range(1000):
        queue.put(asks(GREEDY, number))
    assert queue.take() == asks(GREEDY, 0)
    queue.put(asks(HONEST, 2000))
    queue.put(asks(HONEST, 2001))
    taken = [queue.take() for _ in range(4)]
    assert taken == [asks(GREEDY, 1), asks(HONEST, 2000), asks(GREEDY, 2), asks(HONEST, 2001)]


def test_a_robots_events_keep_their_order_and_nothing_is_lost() -> None:
    queue = EventQueue()
    assert not queue
    mine: list[ApplicationEvent] = [
        asks(HONEST, 1),
        CancelExecution(ExecutionId(1), HONEST),
        asks(HONEST, 2),
        AbandonExecution(ExecutionId(2), HONEST),
    ]
    for event in (*mine, GONE):
        queue.put(event)
    assert queue
    taken = [queue.take() for _ in range(5)]
    assert [event for event in taken if event in mine] == mine
    assert GONE in taken
    assert not queue
    assert queue.take() is None
