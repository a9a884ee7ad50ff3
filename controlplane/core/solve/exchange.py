"""Moves two blocks at once: one leaves a full server at a small loss, so that another gains more by coming.

If many servers are equally good, as with estimates that have measured no miss yet, moves of single blocks end far from
the best: a block that sits where others would gain has no reason of its own to leave.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from plr.controlplane.core.solve.incumbent import Standing

    Floats = NDArray[np.float64]
    Indices = NDArray[np.intp]

MAX_ROUNDS = 30
"""Passes over all blocks; each but the last saves something."""

MIN_GAIN = 1e-9
"""Minimum saving of a trade."""


class Move(NamedTuple):
    """A block's alternative choice."""

    stack: int
    row: int
    picks: Indices
    cost: float
    excess: int
    more: float
    """How much more it costs than the present one."""


def trade(standing: Standing, out_of_time: Callable[[], bool]) -> None:
    """Trade until that gains nothing."""
    for _ in range(MAX_ROUNDS):
        if out_of_time() or not _round(standing):
            return


def _round(standing: Standing) -> bool:
    full = np.append(standing.load >= standing.limits.capacity, False)
    wishes = _wishes(standing, full)
    wanted = np.zeros_like(full)
    wanted[list(wishes)] = True
    leaving = _leaving(standing, wanted, full)
    saved = False
    for limit, comers in wishes.items():
        goers = leaving.get(limit, [])
        comers.sort(key=lambda move: (move.more, move.stack, move.row))
        goers.sort(key=lambda move: (move.more, move.stack, move.row))
        for comer, goer in zip(comers, goers, strict=False):
            if comer.more + goer.more > -MIN_GAIN:
                break
            saved |= standing.exchange(goer, comer)
    return saved


def _wishes(standing: Standing, full: NDArray[np.bool_]) -> dict[int, list[Move]]:
    """Return by full limit the blocks that would gain by coming if exactly this limit were not in the way."""
    found: dict[int, list[Move]] = {}
    for number, (stack, part) in enumerate(zip(standing.stacks, standing.parts, strict=True)):
        best = stack.free
        more = best.value - part.cost
        gaining = np.flatnonzero((more < -MIN_GAIN) & (best.excess <= part.excess))
        now = np.take_along_axis(stack.limit, part.picks, 1)
        then = np.take_along_axis(stack.limit, best.picks, 1)
        for row in gaining.tolist():
            held = now[row].tolist()
            new = {limit for limit in then[row].tolist() if full[limit] and limit not in held}
            if len(new) == 1:
                move = Move(number, row, best.picks[row], float(best.value[row]), int(best.excess[row]), more[row])
                found.setdefault(new.pop(), []).append(move)
    return found


def _leaving(standing: Standing, wanted: NDArray[np.bool_], full: NDArray[np.bool_]) -> dict[int, list[Move]]:
    """Return by wanted limit the blocks under it, with the cost of their best choice outside it and any full one."""
    found: dict[int, list[Move]] = {}
    for number, (stack, part) in enumerate(zip(standing.stacks, standing.parts, strict=True)):
        used = np.take_along_axis(stack.limit, part.picks, 1)
        rows = np.flatnonzero(wanted[used].any(axis=1))
        if not rows.size:
            continue
        own = (part.picks[rows][:, :, None] == np.arange(stack.servers + 1)).any(axis=1)
        # It may stay at a full server that nobody wants, but not go to a full one.
        shut = wanted[stack.limit[rows]] | (full[stack.limit[rows]] & ~own)
        shut[:, stack.servers] = False
        best = stack.best(rows, np.where(shut, np.inf, 0.0))
        more = best.value - part.cost[rows]
        for k in np.flatnonzero(np.isfinite(more) & (best.excess <= part.excess[rows])).tolist():
            row = int(rows[k])
            left = {limit for limit in used[row].tolist() if wanted[limit]}
            move = Move(number, row, best.picks[k], float(best.value[k]), int(best.excess[k]), more[k])
            found.setdefault(min(left), []).append(move)
    return found
