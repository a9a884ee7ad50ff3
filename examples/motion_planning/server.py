"""Motion planning server: answers nav_msgs/srv/GetPlan at /plan_path with A* on a warehouse map.

examples:
  python -m examples.motion_planning.server
  python -m examples.motion_planning.server --delay-ms 2000 --delay-every 20   # now and then very slow
"""

from __future__ import annotations

import argparse
import itertools
import math
import sys
from typing import Any

from geometry_msgs.msg import PoseStamped
from nav_msgs.srv import GetPlan

from examples import service_server
from examples.motion_planning import warehouse
from examples.motion_planning.astar import GridPlanner, corners

SERVICE = "/plan_path"


class PlanService:
    """Plans on one warehouse."""

    def __init__(self, floor: warehouse.Warehouse) -> None:
        self._floor = floor
        self._planner = GridPlanner(floor.blocked)

    def answer(self, request: Any, response: Any) -> dict[str, Any]:
        """Fill the path from start to goal; it stays empty if there is none, as GetPlan defines."""
        start, goal = request.start.pose.position, request.goal.pose.position
        first, last = self._floor.cell_at(start.x, start.y), self._floor.cell_at(goal.x, goal.y)
        cells = self._planner.plan(first, last) if first is not None and last is not None else None
        response.plan.header = request.start.header
        if cells is not None:
            # The path begins and ends exactly where it was asked to, not at the centres of those cells.
            response.plan.poses = [request.start, *self._poses(cells, request.start.header), request.goal]
        return {
            "start": [start.x, start.y],
            "goal": [goal.x, goal.y],
            "poses": len(response.plan.poses),
        }

    def _poses(self, cells: list[warehouse.Cell], header: Any) -> list[Any]:
        """The cells between start and goal at which the path turns, each facing the next."""
        turns = corners(cells)
        poses = []
        for here, ahead in itertools.pairwise(turns[1:]):
            pose = PoseStamped(header=header)
            pose.pose.position.x, pose.pose.position.y = self._floor.point_of(here)
            yaw = math.atan2(ahead[0] - here[0], ahead[1] - here[1])
            pose.pose.orientation.z, pose.pose.orientation.w = math.sin(yaw / 2), math.cos(yaw / 2)
            poses.append(pose)
        return poses


def main() -> int:
    """Command line."""
    parser = argparse.ArgumentParser(
        prog="python -m examples.motion_planning.server",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    service_server.add_arguments(parser)
    parser.add_argument("--map-seed", type=int, default=7, help="which warehouse (default %(default)s)")
    options = parser.parse_args()
    service = PlanService(warehouse.generate(options.map_seed))
    return service_server.run("motion_planner", GetPlan, SERVICE, service.answer, options)


if __name__ == "__main__":
    sys.exit(main())
