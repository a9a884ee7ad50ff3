"""A robot that asks /plan_path (nav_msgs/srv/GetPlan) for a new path ten times a second.

It never waits for an answer before it asks again, checks that each answer belongs to its request, and exits with 0
only if every request was answered exactly once and rightly.

examples:
  python -m examples.motion_planning.client --duration 60
  python -m examples.motion_planning.client --rate 50 --deadline-ms 50 --json run.json
"""

from __future__ import annotations

import argparse
import itertools
import math
import random
import sys
from typing import Any

from nav_msgs.srv import GetPlan

from examples import robot_client
from examples.motion_planning import warehouse

SERVICE = "/plan_path"


class PlanRequests:
    """Asks for paths between random places of a warehouse that the robot knows as well as the server does."""

    def __init__(self, floor: warehouse.Warehouse, rng: random.Random) -> None:
        self._floor = floor
        self._rng = rng

    def request(self, stamp: Any) -> Any:
        """A request from one random point to another."""
        request = GetPlan.Request()
        for end in (request.start, request.goal):
            end.header.stamp = stamp
            end.header.frame_id = "map"
            end.pose.position.x, end.pose.position.y = self._floor.random_point(self._rng)
        return request

    def check(self, request: Any, response: Any) -> tuple[str | None, dict[str, float]]:
        """See `robot_client.Workload.check`. Every request has its own start and goal, which the path must have too."""
        poses = response.plan.poses
        if not poses:
            return "empty path", {}
        detail = {"path_poses": float(len(poses)), "path_m": _length_m(poses)}
        if poses[0] != request.start or poses[-1] != request.goal:
            return "path of another request", detail
        if not all(self._clear(here, ahead) for here, ahead in itertools.pairwise(poses)):
            return "path through an obstacle", detail
        return None, detail

    def _clear(self, here: Any, ahead: Any) -> bool:
        """Whether the straight way between two poses is free, looked at every half cell."""
        a, b = here.pose.position, ahead.pose.position
        looks = math.ceil(_step_m(here, ahead) / (0.5 * self._floor.resolution_m)) + 1
        return all(
            self._floor.is_free(a.x + (b.x - a.x) * look / looks, a.y + (b.y - a.y) * look / looks)
            for look in range(looks + 1)
        )


def _step_m(here: Any, ahead: Any) -> float:
    a, b = here.pose.position, ahead.pose.position
    return math.hypot(a.x - b.x, a.y - b.y)


def _length_m(poses: list[Any]) -> float:
    return sum(_step_m(here, ahead) for here, ahead in itertools.pairwise(poses))


def main() -> int:
    """Command line."""
    parser = argparse.ArgumentParser(
        prog="python -m examples.motion_planning.client",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    robot_client.add_arguments(parser, rate_hz=10.0, deadline_ms=100.0)
    parser.add_argument(
        "--map-seed", type=int, default=7, help="which warehouse, as at the server (default %(default)s)"
    )
    options = parser.parse_args()
    workload = PlanRequests(warehouse.generate(options.map_seed), random.Random(options.seed))
    return robot_client.run("robot", GetPlan, SERVICE, workload, options)


if __name__ == "__main__":
    sys.exit(main())
