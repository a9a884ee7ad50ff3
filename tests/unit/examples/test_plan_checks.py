"""The motion planning robot accepts its server's paths and no others."""

from __future__ import annotations

import copy
import random
from typing import Any

import pytest
from builtin_interfaces.msg import Time
from nav_msgs.srv import GetPlan

from examples.motion_planning.client import PlanRequests
from examples.motion_planning.server import PlanService
from examples.motion_planning.warehouse import Warehouse, generate

pytestmark = pytest.mark.ros

FLOOR = generate(7)


def robot(seed: int = 1, floor: Warehouse = FLOOR) -> PlanRequests:
    return PlanRequests(floor, random.Random(seed))


def answered(request: Any) -> Any:
    response = GetPlan.Response()
    PlanService(FLOOR).answer(request, response)
    return response


@pytest.mark.parametrize("seed", range(30))
def test_a_right_answer_has_no_problem(seed: int) -> None:
    asker = robot(seed)
    request = asker.request(Time(sec=seed))
    problem, detail = asker.check(request, answered(request))
    assert problem is None
    assert detail["path_poses"] >= 2


def test_an_answer_to_another_request_is_one() -> None:
    asker = robot()
    first, second = asker.request(Time(sec=1)), asker.request(Time(sec=2))
    assert asker.check(first, answered(second))[0] == "path of another request"


def test_an_answer_to_the_same_places_at_another_time_is_of_another_request() -> None:
    asker = robot()
    request = asker.request(Time(sec=1))
    again = copy.deepcopy(request)
    again.start.header.stamp.sec = 2
    assert asker.check(request, answered(again))[0] == "path of another request"


def test_an_empty_answer_is_no_path() -> None:
    asker = robot()
    assert asker.check(asker.request(Time()), GetPlan.Response())[0] == "empty path"


def test_a_path_with_its_middle_missing_goes_through_a_rack() -> None:
    asker = robot()
    for _ in range(20):
        request = asker.request(Time())
        response = answered(request)
        if len(response.plan.poses) > 6:
            response.plan.poses = [response.plan.poses[0], response.plan.poses[-1]]
            assert asker.check(request, response)[0] == "path through an obstacle"
            return
    pytest.fail("no path with corners")


def test_a_request_from_within_a_rack_gets_an_empty_path() -> None:
    request = GetPlan.Request()
    assert answered(request).plan.poses == []
