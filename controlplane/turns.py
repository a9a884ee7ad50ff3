"""Work of the event loop that takes long, cut into turns: between two of them the loop does whatever else is due.

All such work of a program takes its turns from one `Turns`, so that however much of it is under way, one turn of it at
most stands between two looks of the loop at its streams.
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
"""Processor time of a turn. What is done with its results, as encoding them, comes on top."""


class Turns:
    """For one event loop; who waits longest is next."""

    def __init__(self) -> None:
        self._turn = asyncio.Lock()

    async def each(self, items: Iterable[T], work: Callable[[T], R], times: float = 1.0) -> AsyncIterator[list[R]]:
        """Yield what `work` makes of each item, as lists of what one turn made.

        `times`: a turn of it is so many times as long as the usual one. The items are taken as the turns come: an
        iterable may follow what happens meanwhile.
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
