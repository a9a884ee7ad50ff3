"""A warehouse floor as an occupancy grid: racks in rows, cross aisles, pallets standing about."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    import random

    from numpy.typing import NDArray

RESOLUTION_M = 0.2
WIDTH_M, HEIGHT_M = 24.0, 15.0
# The robot's centre keeps this far from anything, in cells: a robot of 0.4 m diameter.
ROBOT_RADIUS_CELLS = 1
RACK_DEPTH_CELLS = 4
AISLE_CELLS = 8
CROSS_AISLE_EVERY_CELLS = 40
PALLETS = 22
PALLET_CELLS = 4

Cell = tuple[int, int]


@dataclass(frozen=True, slots=True, eq=False)
class Warehouse:
    """`blocked[row, column]`: cells that the robot's centre must not enter; every free cell reaches every other."""

    blocked: NDArray[np.bool_]
    resolution_m: float = RESOLUTION_M

    def cell_at(self, x: float, y: float) -> Cell | None:
        """The (row, column) of a point in metres; None outside the map."""
        row, column = int(y // self.resolution_m), int(x // self.resolution_m)
        rows, columns = self.blocked.shape
        return (row, column) if 0 <= row < rows and 0 <= column < columns else None

    def point_of(self, cell: Cell) -> tuple[float, float]:
        """The centre (x, y) of a cell, in metres."""
        return (cell[1] + 0.5) * self.resolution_m, (cell[0] + 0.5) * self.resolution_m

    def is_free(self, x: float, y: float) -> bool:
        """Whether the robot may stand at a point."""
        cell = self.cell_at(x, y)
        return cell is not None and not self.blocked[cell]

    def random_point(self, rng: random.Random) -> tuple[float, float]:
        """A point (x, y) in metres where the robot may stand, never twice the same."""
        rows, columns = self.blocked.shape
        while True:
            x, y = rng.random() * columns * self.resolution_m, rng.random() * rows * self.resolution_m
            if self.is_free(x, y):
                return x, y


def generate(seed: int) -> Warehouse:
    """The warehouse that belongs to a seed."""
    rng = np.random.default_rng(seed)
    rows, columns = int(HEIGHT_M / RESOLUTION_M), int(WIDTH_M / RESOLUTION_M)
    solid = np.zeros((rows, columns), dtype=np.bool_)
    solid[[0, -1], :] = solid[:, [0, -1]] = True
    for top in range(AISLE_CELLS, rows - AISLE_CELLS, RACK_DEPTH_CELLS + AISLE_CELLS):
        solid[top : top + RACK_DEPTH_CELLS, AISLE_CELLS:-AISLE_CELLS] = True
        # Each row of racks has its cross aisles somewhere else: no straight way through.
        shift = int(rng.integers(CROSS_AISLE_EVERY_CELLS))
        for left in range(AISLE_CELLS + shift, columns - AISLE_CELLS, CROSS_AISLE_EVERY_CELLS):
            solid[top : top + RACK_DEPTH_CELLS, left : left + AISLE_CELLS] = False
    for row, column in rng.integers((0, 0), (rows - PALLET_CELLS, columns - PALLET_CELLS), size=(PALLETS, 2)):
        solid[row : row + PALLET_CELLS, column : column + PALLET_CELLS] = True
    return Warehouse(_only_largest_room(_grow(solid, ROBOT_RADIUS_CELLS)))


def _grow(solid: NDArray[np.bool_], cells: int) -> NDArray[np.bool_]:
    """`solid` made larger by `cells` on every side."""
    grown = solid.copy()
    rows, columns = solid.shape
    for down in range(-cells, cells + 1):
        for right in range(-cells, cells + 1):
            grown[max(0, down) : rows + min(0, down), max(0, right) : columns + min(0, right)] |= solid[
                max(0, -down) : rows + min(0, -down), max(0, -right) : columns + min(0, -right)
            ]
    return grown


def _only_largest_room(blocked: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """`blocked` with every free region but the largest blocked as well."""
    unseen = ~blocked
    largest = np.zeros_like(blocked)
    while unseen.any():
        row, column = np.argwhere(unseen)[0]
        room = np.zeros_like(blocked)
        todo = [(int(row), int(column))]
        unseen[row, column] = False
        while todo:
            row, column = todo.pop()
            room[row, column] = True
            for beside in ((row - 1, column), (row + 1, column), (row, column - 1), (row, column + 1)):
                if unseen[beside]:
                    unseen[beside] = False
                    todo.append(beside)
        if room.sum() > largest.sum():
            largest = room
    return ~largest
