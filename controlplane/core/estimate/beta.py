"""Computes quantiles of many Beta distributions at once.

The distribution function is the regularised incomplete beta function, by its continued fraction (DLMF 8.17.22) with the
modified method of Lentz. The quantile is where it takes the wanted value, found by Newton's method within a bracket
that shrinks at every step.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, TypeVar

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Generator, Sequence

    from numpy.typing import NDArray

    from plr.controlplane.core.estimate.posterior import Estimate

    Floats = NDArray[np.float64]

T = TypeVar("T")

STEPS = 60
"""Halvings of [0, 1] after which no visible digit changes; Newton's method needs a few."""

TERMS = 400
"""Terms of the continued fraction; some multiple of the square root of a distribution's weight is enough."""

TERMS_A_STEP = 20
"""Terms computed in one step: about a millisecond, for up to a thousand distributions."""

_TINY = 1e-300
_log_gamma = np.vectorize(math.lgamma, otypes=[np.float64])


def intervals(estimates: Sequence[Estimate], level: float) -> list[tuple[float, float]]:
    """Return what `interval_steps` returns, in one go."""
    return _finished(interval_steps(estimates, level))


def interval_steps(estimates: Sequence[Estimate], level: float) -> Generator[None, None, list[tuple[float, float]]]:
    """Return for each estimate the interval that holds it with probability `level`, with equal tails.

    Yield after every millisecond or so: a hundred estimates may take a tenth of a second.

    With fewer than one miss, or hit, behind an estimate, its Beta distribution is all but one point at 0, or 1. The
    interval then reaches as far as n trials without a miss, or hit, leave open: 3 / n for 90 % (the rule of three).
    """
    if not estimates:
        return []
    misses = np.array([estimate.misses for estimate in estimates])
    hits = np.array([estimate.hits for estimate in estimates])
    low = yield from _quantile_steps(misses, hits, (1.0 - level) / 2.0)
    high = yield from _quantile_steps(misses, hits, (1.0 + level) / 2.0)
    open_end = ((1.0 - level) / 2.0) ** (1.0 / (misses + hits))
    low = np.where(hits < 1.0, np.minimum(low, open_end), low)
    high = np.where(misses < 1.0, np.maximum(high, 1.0 - open_end), high)
    # Within rounding both may be 0, and then in any order.
    return list(zip(low.tolist(), np.maximum(low, high).tolist(), strict=True))


def quantiles(a: Floats, b: Floats, share: float) -> Floats:
    """Return for each Beta(a, b) the value below which `share` of it lies, within 1e-12."""
    return _finished(_quantile_steps(a, b, share))


def _finished(steps: Generator[None, None, T]) -> T:
    while True:
        try:
            next(steps)
        except StopIteration as end:
            found: T = end.value
            return found


def _quantile_steps(a: Floats, b: Floats, share: float) -> Generator[None, None, Floats]:
    log_norm = _log_gamma(a + b) - _log_gamma(a) - _log_gamma(b)
    low, high = np.zeros_like(a), np.ones_like(a)
    at = a / (a + b)
    for _ in range(STEPS):
        yield
        off = (yield from _below(a, b, at, log_norm)) - share
        high = np.where(off > 0.0, at, high)
        low = np.where(off > 0.0, low, at)
        if np.all(high - low < 1e-12):
            break
        with np.errstate(all="ignore"):
            density = np.exp(log_norm + (a - 1.0) * np.log(at) + (b - 1.0) * np.log1p(-at))
            step = at - off / density
        inside = np.isfinite(step) & (step > low) & (step < high)
        following = np.where(inside, step, (low + high) / 2.0)
        if np.all(np.abs(following - at) < 1e-13):
            break
        at = following
    return at


def _below(a: Floats, b: Floats, at: Floats, log_norm: Floats) -> Generator[None, None, Floats]:
    """Return the share of each Beta(a, b) below `at`."""
    with np.errstate(divide="ignore"):
        front = np.exp(log_norm + a * np.log(at) + b * np.log1p(-at))
    # The fraction converges fast on this side of the mean; the other side is its mirror image.
    mirrored = at > (a + 1.0) / (a + b + 2.0)
    p, q = np.where(mirrored, b, a), np.where(mirrored, a, b)
    x = np.where(mirrored, 1.0 - at, at)
    share = front * (yield from _fraction(p, q, x)) / p
    result: Floats = np.where(mirrored, 1.0 - share, share)
    return result


def _fraction(a: Floats, b: Floats, x: Floats) -> Generator[None, None, Floats]:
    c = np.ones_like(x)
    d = 1.0 / _nonzero(1.0 - (a + b) * x / (a + 1.0))
    value = d.copy()
    for m in range(1, TERMS):
        if m % TERMS_A_STEP == 0:
            yield
        even = m * (b - m) * x / ((a + 2 * m - 1) * (a + 2 * m))
        odd = -(a + m) * (a + b + m) * x / ((a + 2 * m) * (a + 2 * m + 1))
        for term in (even, odd):
            d = 1.0 / _nonzero(1.0 + term * d)
            c = _nonzero(1.0 + term / c)
            change = c * d
            value *= change
        if np.all(np.abs(change - 1.0) < 1e-13):
            break
    return value


def _nonzero(values: Floats) -> Floats:
    result: Floats = np.where(np.abs(values) < _TINY, _TINY, values)
    return result
