"""Long work of the loop is cut into turns, and nothing of it is lost."""

from __future__ import annotations

import asyncio

import pytest

from plr.controlplane import turns
from plr.controlplane.turns import Turns

pytestmark = pytest.mark.audit("ops-19")


def test_all_is_done_in_order_and_others_come_in_between(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(turns, "TURN_S", 0.0)
    passes = 0

    async def others() -> None:
        nonlocal passes
        while True:
            passes += 1
            await asyncio.sleep(0)

    async def run() -> list[list[int]]:
        other = asyncio.create_task(others())
        found = [part async for part in Turns().each(range(50), lambda number: 2 * number)]
        other.cancel()
        return found

    assert asyncio.run(run()) == [[2 * number] for number in range(50)]
    assert passes >= 50


def test_a_short_work_is_one_turn_and_none_is_nothing() -> None:
    async def run(count: int) -> list[list[int]]:
        return [part async for part in Turns().each(range(count), lambda number: number)]

    assert asyncio.run(run(3)) == [[0, 1, 2]]
    assert asyncio.run(run(0)) == []


def test_however_many_works_are_under_way_one_turn_is_between_two_looks_at_the_rest(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(turns, "TURN_S", 0.0)
    done = 0
    most = 0

    def work(_: int) -> None:
        nonlocal done
        done += 1

    async def run() -> None:
        nonlocal done, most
        shared = Turns()

        async def one() -> None:
            async for _ in shared.each(range(20), work):
                pass

        works = [asyncio.create_task(one()) for _ in range(8)]
        while not all(task.done() for task in works):
            before = done
            await asyncio.sleep(0)
            most = max(most, done - before)

    asyncio.run(run())
    assert done == 8 * 20
    assert most <= 2, "a pass of asyncio's loop runs what is ready, and what that makes ready in the next"
