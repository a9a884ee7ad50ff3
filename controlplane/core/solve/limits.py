"""The limits over all robots of one problem, numbered, and the interfaces they hold."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from controlplane.core.problem.problem import FleetKey

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from controlplane.core.problem.problem import Block, Problem


class Limits:
    """Numbers the limits of a problem; the number after the last stands for "no limit"."""

    def __init__(self, problem: Problem) -> None:
        self.keys: tuple[FleetKey, ...] = tuple(problem.fleet_capacity)
        self.capacity: NDArray[np.int64] = np.array([problem.fleet_capacity[key] for key in self.keys], dtype=np.int64)
        self._number = {key: number for number, key in enumerate(self.keys)}

    def __len__(self) -> int:
        return len(self.keys)

    def of_block(self, block: Block) -> list[int]:
        """The number of each server's limit."""
        service, without = block.key.service, len(self.keys)
        return [self._number.get(FleetKey(server, service), without) for server in block.servers]

    def loads(self, limits_used: Sequence[NDArray[np.intp]]) -> NDArray[np.int64]:
        """Interfaces held by each limit, given the limit that each interface falls under."""
        count = np.zeros(len(self.keys) + 1, dtype=np.int64)
        for used in limits_used:
            count += np.bincount(used.ravel(), minlength=len(self.keys) + 1)
        return count[:-1]
