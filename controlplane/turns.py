"""Cuts long work of the event loop into turns, between which the loop does whatever else is due.

All such work of a program takes its turns from one `Turns`. However much of it is under way, the loop never runs more
than one turn before it serves its streams again.
"""

from __future__ import annotations

import asyncio
import time
from typing import TYPE_CHECKING, TypeVar

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable, Iterable

T = TypeVar("T")
R = TypeVar("R")

TURN_S = 0.002
"""Processor time of a turn. Work on its results, such as encoding them, comes on top."""


class Turns:
    """The turns of one event loop, granted in order of arrival."""

    def __init__(self) -> None:
        self._turn = asyncio.Lock()

    async def each(self, items: Iterable[T], work: Callable[[T], R], times: float = 1.0) -> AsyncIterator[list[R]]:
        """Apply `work` to each item and yield the results, one list for each turn.

        `times` is the length of a turn in multiples of `TURN_S`. Items are drawn turn by turn, so the iterable may
        reflect what happens meanwhile.
        """
        rest = iter(items)
        done = False
        while not done:
            async with self._turn:
                await asyncio.sleep(0)
                found, done = _one_turn(rest, work, times * TURN_S)
            if found:
                yield found


def _one_turn(items: Iterable[T], work: Callable[[T], R], turn_s: float) -> tuple[list[R], bool]:
    ends = time.thread_time() + turn_s
    found: list[R] = []
    for item in items:
        found.append(work(item))
        if time.thread_time() >= ends:
            return found, False
    return found, True
