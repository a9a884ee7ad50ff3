"""A* on an 8-connected grid (Hart, Nilsson and Raphael, 1968), with the octile distance as its heuristic."""

from __future__ import annotations

import heapq
import math
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from examples.motion_planning.warehouse import Cell

DIAGONAL = math.sqrt(2.0)


class GridPlanner:
    """Plans on one map. The border of the map must be blocked, so that no search looks over its edge."""

    def __init__(self, blocked: NDArray[np.bool_]) -> None:
        if not (blocked[[0, -1], :].all() and blocked[:, [0, -1]].all()):
            raise ValueError("the border of the map must be blocked")
        self._columns = int(blocked.shape[1])
        # One flat list: a search touches single cells, which numpy is slow at.
        self._blocked: list[bool] = blocked.ravel().tolist()

    def plan(self, start: Cell, goal: Cell) -> list[Cell] | None:
        """The cells of a shortest path from start to goal, both included; None if there is none.

        Diagonal steps never cut the corner of a blocked cell. Lengths are in cells.
        """
        columns, blocked = self._columns, self._blocked
        source, target = start[0] * columns + start[1], goal[0] * columns + goal[1]
        if blocked[source] or blocked[target]:
            return None
        goal_row, goal_column = goal
        straight = (-1, 1, -columns, columns)
        diagonal = ((-1, -columns), (1, -columns), (-1, columns), (1, columns))
        cost = {source: 0.0}
        parent = {source: source}
        closed: set[int] = set()
        frontier = [(0.0, source)]
        while frontier:
            _, cell = heapq.heappop(frontier)
            if cell == target:
                return self._path(parent, target)
            if cell in closed:
                continue
            closed.add(cell)
            steps = [(cell + step, 1.0) for step in straight if not blocked[cell + step]]
            steps += [
                (cell + along + across, DIAGONAL)
                for along, across in diagonal
                if not (blocked[cell + along] or blocked[cell + across] or blocked[cell + along + across])
            ]
            for beside, length in steps:
                reached = cost[cell] + length
                if reached < cost.get(beside, math.inf):
                    cost[beside] = reached
                    parent[beside] = cell
                    down = abs(beside // columns - goal_row)
                    right = abs(beside % columns - goal_column)
                    ahead = max(down, right) + (DIAGONAL - 1.0) * min(down, right)
                    heapq.heappush(frontier, (reached + ahead, beside))
        return None

    def _path(self, parent: dict[int, int], target: int) -> list[Cell]:
        path = [target]
        while parent[path[-1]] != path[-1]:
            path.append(parent[path[-1]])
        return [divmod(cell, self._columns) for cell in reversed(path)]


def corners(path: list[Cell]) -> list[Cell]:
    """The cells of a path at which it begins, turns and ends; between them it runs straight."""
    kept = path[:1]
    for before, here, ahead in zip(path, path[1:], path[2:], strict=False):
        if (here[0] - before[0], here[1] - before[1]) != (ahead[0] - here[0], ahead[1] - here[1]):
            kept.append(here)
    return kept + path[1:][-1:]
