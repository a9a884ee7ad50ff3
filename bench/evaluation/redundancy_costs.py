"""Computes what each redundancy mode avoids and costs: misses against bytes, over windows with all necessary runs."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from bench.evaluation.comparison import DIRECT, SUREST

if TYPE_CHECKING:
    from collections.abc import Mapping

    from bench.evaluation.outcome import Figures, Windows

CHEAPEST = "plr-single"
MODES = (CHEAPEST, "plr-hedge-10%", "plr-hedge", "plr-adaptive-10%", "plr-adaptive", SUREST)
NEEDED = frozenset((*DIRECT, CHEAPEST, SUREST))
"""A window counts if all of these ran in it."""


@dataclass(frozen=True, slots=True)
class ModeCost:
    """One mode, over all windows in which it ran beside both direct runs, `single` and `replicate`."""

    windows: int
    miss_ratio: float
    bytes_per_request: float
    avoided: float | None
    """Misses of the better direct run of each window that it avoids, as a share of those that `replicate` avoids; None
    if there are none."""
    extra_bytes: float
    """Bytes beyond those of `single`, as a share of them."""


def mode_costs(windows: Windows) -> dict[str, ModeCost]:
    """Return mode -> cost."""
    complete = [window for window in windows.values() if window.keys() >= NEEDED]
    found = {mode: _cost(mode, [window for window in complete if mode in window]) for mode in MODES}
    return {mode: cost for mode, cost in found.items() if cost is not None}


def _cost(mode: str, windows: list[Mapping[str, Figures]]) -> ModeCost | None:
    sent = sum(_bytes(window[mode]) for window in windows)
    least = sum(_bytes(window[CHEAPEST]) for window in windows)
    if not least:
        return None
    requests = sum(window[mode].requests for window in windows)
    misses = sum(window[mode].misses for window in windows)
    alone = sum(min(window[direct].misses for direct in DIRECT) for window in windows)
    avoidable = alone - sum(window[SUREST].misses for window in windows)
    return ModeCost(
        windows=len(windows),
        miss_ratio=misses / requests,
        bytes_per_request=sent / requests,
        avoided=(alone - misses) / avoidable if avoidable > 0 else None,
        extra_bytes=sent / least - 1.0,
    )


def _bytes(figures: Figures) -> float:
    return (figures.bytes_per_request or 0.0) * figures.requests
