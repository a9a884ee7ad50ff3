"""A* finds shortest paths: the same lengths as Dijkstra's algorithm by another hand."""

from __future__ import annotations

import math
import random
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np
import pytest
from scipy.sparse import lil_matrix
from scipy.sparse.csgraph import dijkstra

from examples.motion_planning.astar import GridPlanner, corners
from examples.motion_planning.warehouse import generate

if TYPE_CHECKING:
    from numpy.typing import NDArray

SIDE = 12


def random_map(seed: int, density: float) -> NDArray[np.bool_]:
    blocked = np.random.default_rng(seed).random((SIDE, SIDE)) < density
    blocked[[0, -1], :] = blocked[:, [0, -1]] = True
    return blocked


def all_lengths(blocked: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Shortest lengths between all pairs of cells; infinite where there is no way."""
    graph = lil_matrix((SIDE * SIDE, SIDE * SIDE))
    for row in range(1, SIDE - 1):
        for column in range(1, SIDE - 1):
            for down in (-1, 0, 1):
                for right in (-1, 0, 1):
                    # The corner cells of the step's bounding box must all be free.
                    passed = {(row, column), (row + down, column), (row, column + right), (row + down, column + right)}
                    if (down or right) and not any(blocked[cell] for cell in passed):
                        graph[row * SIDE + column, (row + down) * SIDE + column + right] = math.hypot(down, right)
    lengths: NDArray[np.float64] = dijkstra(graph.tocsr())
    return lengths


@pytest.mark.parametrize("seed", range(20))
def test_paths_are_shortest(seed: int) -> None:
    rng = random.Random(seed)
    blocked = random_map(seed, density=0.1 + 0.4 * rng.random())
    lengths, planner = all_lengths(blocked), GridPlanner(blocked)
    free = [(int(row), int(column)) for row, column in np.argwhere(~blocked)]
    for _ in range(20):
        start, goal = rng.choice(free), rng.choice(free)
        expected = lengths[start[0] * SIDE + start[1], goal[0] * SIDE + goal[1]]
        path = planner.plan(start, goal)
        if path is None:
            assert expected == math.inf
            continue
        assert path[0] == start
        assert path[-1] == goal
        steps = [math.hypot(b[0] - a[0], b[1] - a[1]) for a, b in pairwise(path)]
        assert all(step <= math.sqrt(2) for step in steps)
        assert sum(steps) == pytest.approx(expected)


def test_a_blocked_end_has_no_path() -> None:
    blocked = random_map(1, density=0.0)
    blocked[5, 5] = True
    planner = GridPlanner(blocked)
    assert planner.plan((5, 5), (2, 2)) is None
    assert planner.plan((2, 2), (5, 5)) is None
    assert planner.plan((2, 2), (2, 2)) == [(2, 2)]


def test_an_open_border_is_refused() -> None:
    with pytest.raises(ValueError, match="border"):
        GridPlanner(np.zeros((4, 4), dtype=np.bool_))


@pytest.mark.parametrize("seed", range(5))
def test_every_free_cell_of_a_warehouse_can_be_reached(seed: int) -> None:
    floor = generate(seed)
    assert 0.25 < (~floor.blocked).mean() < 0.75
    assert np.array_equal(floor.blocked, generate(seed).blocked)
    planner, rng = GridPlanner(floor.blocked), random.Random(seed)
    for _ in range(10):
        start, goal = floor.cell_at(*floor.random_point(rng)), floor.cell_at(*floor.random_point(rng))
        assert start is not None
        assert goal is not None
        assert planner.plan(start, goal) is not None


def test_points_and_cells_agree() -> None:
    floor = generate(7)
    assert floor.cell_at(*floor.point_of((3, 9))) == (3, 9)
    assert floor.cell_at(-0.01, 1.0) is None
    assert floor.cell_at(1.0, 1e6) is None
    assert not floor.is_free(0.0, 0.0)


@pytest.mark.parametrize(
    ("path", "expected"),
    [
        ([], []),
        ([(1, 1)], [(1, 1)]),
        ([(1, 1), (1, 2)], [(1, 1), (1, 2)]),
        ([(1, 1), (1, 2), (1, 3), (1, 4)], [(1, 1), (1, 4)]),
        ([(1, 1), (1, 2), (2, 3), (3, 4), (4, 4)], [(1, 1), (1, 2), (3, 4), (4, 4)]),
    ],
)
def test_a_path_is_kept_where_it_turns(path: list[tuple[int, int]], expected: list[tuple[int, int]]) -> None:
    assert corners(path) == expected
