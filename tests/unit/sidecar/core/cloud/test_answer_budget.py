from __future__ import annotations

import random

from hypothesis import given
from hypothesis import strategies as st

from plr.protos.model.ids import NodeName
from plr.sidecar.core.cloud.answer_budget import EVICTED_AT_ONCE, HEAP_SLACK, AnswerBudget
from tests.support.builders import request_id

ROBOTS = [NodeName(f"robot-{number}") for number in range(5)]
CAPACITY = 100


@given(st.lists(st.tuples(st.sampled_from(ROBOTS), st.integers(0, 40), st.booleans()), max_size=200))
def test_whoever_holds_the_most_loses_its_oldest(steps: list[tuple[NodeName, int, bool]]) -> None:
    cache, kept = AnswerBudget(CAPACITY), {robot: dict[int, int]() for robot in ROBOTS}
    for number, (robot, size, removes) in enumerate(steps):
        if removes and kept[robot]:
            gone = next(iter(kept[robot]))
            cache.remove(robot, request_id(gone))
            del kept[robot][gone]
            continue
        evicted = cache.add(robot, request_id(number), size)
        kept[robot][number] = size
        for greediest, oldest in evicted:
            held = {name: sum(sizes.values()) for name, sizes in kept.items()}
            assert sum(held.values()) > CAPACITY
            assert held[greediest] == max(held.values())
            first = next(iter(kept[greediest]))
            assert oldest == request_id(first)
            del kept[greediest][first]
        assert cache.held_bytes == sum(sum(sizes.values()) for sizes in kept.values()) <= CAPACITY


def test_a_large_answer_drives_out_many_small_ones_over_several_calls() -> None:
    cache = AnswerBudget(10 * EVICTED_AT_ONCE)
    robot = ROBOTS[0]
    for number in range(10 * EVICTED_AT_ONCE):
        cache.add(robot, request_id(number), 1)
    assert len(cache.add(robot, request_id(1 << 40), 5 * EVICTED_AT_ONCE)) == EVICTED_AT_ONCE
    assert cache.held_bytes > 10 * EVICTED_AT_ONCE
    for number in range(1, 10):
        cache.add(robot, request_id((1 << 40) + number), 1)
    assert cache.held_bytes <= 10 * EVICTED_AT_ONCE


def test_outdated_entries_do_not_pile_up() -> None:
    cache, rng = AnswerBudget(1000), random.Random(1)
    for number in range(20 * HEAP_SLACK):
        cache.add(rng.choice(ROBOTS), request_id(number), 10)
    assert len(cache._greediest) <= 2 * len(ROBOTS) + HEAP_SLACK + 1
