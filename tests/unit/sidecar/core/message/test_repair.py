from __future__ import annotations

import random

import pytest

from plr.sidecar.core.message.repair import (
    FAILURES,
    FLOOR,
    MAX_DOUBLED_SYMBOLS,
    MAX_RATIO,
    WORTH_A_COPY,
    Loss,
    repair_symbols,
    worth_a_copy,
)
from plr.sidecar.core.wire import fec

COUNTS = (1, 2, 3, 5, 20, 128, 129, 132, 1000, 14_700)


@pytest.mark.parametrize("count", COUNTS)
def test_nothing_is_added_without_loss_or_when_switched_off(count: int) -> None:
    assert repair_symbols(count, None, Loss()) == 0
    assert repair_symbols(count, None, Loss(FLOOR / 2)) == 0
    assert repair_symbols(count, 0.0, Loss(0.1)) == 0


@pytest.mark.parametrize("count", COUNTS)
@pytest.mark.parametrize("ratio", [0.01, 0.3, 1.0])
def test_a_given_ratio_is_kept_whatever_the_loss(count: int, ratio: float) -> None:
    repairs = repair_symbols(count, ratio, Loss(0.5))
    assert ratio * count <= repairs <= ratio * count + 1
    assert repairs <= fec.max_repairs(count)


def test_more_loss_never_asks_for_less() -> None:
    for count in COUNTS:
        asked = [repair_symbols(count, None, Loss(share / 1000)) for share in range(1, 900)]
        assert asked == sorted(asked)
        assert asked[-1] <= max(1, count * MAX_RATIO) + fec.block_count(count)


def test_few_datagrams_are_doubled_only_where_it_pays() -> None:
    assert not worth_a_copy(1, Loss())
    assert not worth_a_copy(1, Loss(0.9 * WORTH_A_COPY))
    assert worth_a_copy(1, Loss(1.01 * WORTH_A_COPY))
    assert worth_a_copy(2, Loss(0.9 * WORTH_A_COPY)), "one of two is lost more often than one of one"
    assert worth_a_copy(MAX_DOUBLED_SYMBOLS, Loss(0.02))
    assert not worth_a_copy(MAX_DOUBLED_SYMBOLS + 1, Loss(0.02))


def test_a_lone_datagram_gets_no_repair_symbol_by_the_loss() -> None:
    assert repair_symbols(1, None, Loss(0.1)) == 0


def test_the_overhead_of_a_camera_frame_is_modest() -> None:
    assert repair_symbols(132, None, Loss(0.02)) <= 16
    assert repair_symbols(132, None, Loss(0.05)) <= 26


@pytest.mark.parametrize(("share", "burst"), [(0.01, 1), (0.02, 1), (0.05, 1), (0.02, 4)])
def test_as_few_messages_fail_as_promised(share: float, burst: int) -> None:
    """Monte Carlo over the real blocks; bursts of `burst` datagrams."""
    rng = random.Random(1)
    count, trials = 132, 3000
    # Bursts of four have four times the variance of single losses.
    repairs = repair_symbols(count, None, Loss(share, float(burst)))
    blocks = fec.block_count(count)
    failed = 0
    for _ in range(trials):
        lost: set[int] = set()
        for index in range(count + repairs):
            if rng.random() < share / burst:
                lost.update(range(index, index + burst))
        by_block = [0] * blocks
        for index in lost:
            if index < count + repairs:
                by_block[(index if index < count else index - count) % blocks] += 1
        failed += any(hit > repairs // blocks for hit in by_block)
    assert failed <= 3 * FAILURES * trials
