"""Derives figures from requests: quantiles, medians of repeats, rows of a table. None means not measured.

A figure compared with a target comes with an interval: how far it moves when the samples are resampled (the bootstrap).
The interval does not cover differences from run to run.
"""

from __future__ import annotations

import itertools
import math
import random
import statistics
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple, Self

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence

MS = 1000.0
DRAWS = 400
"""Number of resamplings for an interval."""
CONFIDENCE = 0.95
STRETCH = 5
"""Messages whose arrivals make one sample of goodput."""
BLOCK = 10
"""Consecutive requests drawn together: a disturbance of one often affects the next."""


class Interval(NamedTuple):
    """The range that holds 95 % of the draws, and the number of samples."""

    low: float
    high: float
    samples: int


def quantile(values: Iterable[float], fraction: float) -> float | None:
    """Return the smallest value that at least `fraction` of the values do not exceed; None if there are no values."""
    ordered = sorted(values)
    return ordered[max(0, math.ceil(fraction * len(ordered)) - 1)] if ordered else None


def p99(values: Iterable[float]) -> float | None:
    """Return the 99th percentile; None if there are no values."""
    return quantile(values, 0.99)


def p99_ratio(samples: Sequence[float], others: Sequence[float]) -> float | None:
    """Return the P99 of the samples over that of the others."""
    return ratio(p99(samples), p99(others))


def median_ratio(samples: Sequence[float], others: Sequence[float]) -> float | None:
    """Return the median of the samples over that of the others."""
    return ratio(median(samples), median(others))


def median(values: Iterable[float | None]) -> float | None:
    """Return the median of what was measured; None if nothing was."""
    known = [value for value in values if value is not None]
    return statistics.median(known) if known else None


def geometric_mean(values: Iterable[float | None]) -> float | None:
    """Return the geometric mean of what was measured; None if nothing was, or a value is not above zero."""
    known = [value for value in values if value is not None]
    return statistics.geometric_mean(known) if known and min(known) > 0 else None


def ratio(one: float | None, other: float | None) -> float | None:
    """Return `one` over `other`; None unless both were measured and `other` is above zero."""
    return one / other if one is not None and other else None


def difference(one: float | None, other: float | None) -> float | None:
    """Return `one` minus `other`; None unless both were measured."""
    return one - other if one is not None and other is not None else None


def worst(values: Iterable[float | None]) -> float | None:
    """Return the largest of what was measured; None if nothing was."""
    return max((value for value in values if value is not None), default=None)


def goodput_of_stretches(calls: Calls, message_bytes: int) -> list[float]:
    """Return the Mbit/s of each stretch of STRETCH messages that arrived one after the other."""
    ends = sorted(calls.arrivals())[::STRETCH]
    return [STRETCH * message_bytes * 8 / 1e6 / max(end - start, 1e-9) for start, end in itertools.pairwise(ends)]


def interval(
    of: Callable[..., float | None], *sets: Sequence[float], block: int = BLOCK, seed: int = 1
) -> Interval | None:
    """Return how far `of(*sets)` moves when each set is resampled, `block` consecutive samples at a time.

    Returns None if a set has fewer than two samples, or a draw gives no figure. `samples` is that of the smallest set.
    Blocks are at most a quarter of a small set: drawn as a whole it would never differ from itself.
    """
    smallest = min(map(len, sets), default=0)
    if smallest < 2:
        return None
    rng = random.Random(seed)
    found = []
    for _ in range(DRAWS):
        value = of(*(_drawn_again(samples, max(1, min(block, len(samples) // 4)), rng) for samples in sets))
        if value is None:
            return None
        found.append(value)
    found.sort()
    cut = round(DRAWS * (1 - CONFIDENCE) / 2)
    return Interval(found[cut], found[-1 - cut], smallest)


def _drawn_again(samples: Sequence[float], block: int, rng: random.Random) -> list[float]:
    """Return as many samples, in blocks that begin anywhere; the first sample follows the last."""
    count = len(samples)
    drawn: list[float] = []
    while len(drawn) < count:
        begin = rng.randrange(count)
        drawn += (samples[(begin + offset) % count] for offset in range(min(block, count - len(drawn))))
    return drawn


@dataclass(frozen=True, slots=True)
class Calls:
    """A run of requests in order of sending."""

    sent_s: tuple[float, ...]
    """Times of sending, CLOCK_MONOTONIC."""
    latency_s: tuple[float | None, ...]
    """Latencies; None if no answer came."""

    @classmethod
    def of(cls, fields: dict[str, Any]) -> Self:
        """Read what `CallLog.as_json` wrote."""
        return cls(tuple(fields["sent_s"]), tuple(fields["latency_s"]))

    def between(self, start_s: float, end_s: float = math.inf) -> Calls:
        """Return only the requests sent in this period."""
        kept = [pair for pair in zip(self.sent_s, self.latency_s, strict=True) if start_s <= pair[0] < end_s]
        return Calls(tuple(sent for sent, _ in kept), tuple(latency for _, latency in kept))

    def arrivals(self) -> list[float]:
        """Return when the answers came."""
        return [sent + latency for sent, latency in self._answered()]

    def line(self, zero_s: float) -> list[tuple[float, float]]:
        """Return for a plot the seconds after `zero_s` and the latency in milliseconds of each answered request."""
        return [(sent - zero_s, latency * MS) for sent, latency in self._answered()]

    def _answered(self) -> list[tuple[float, float]]:
        pairs = zip(self.sent_s, self.latency_s, strict=True)
        return [(sent, latency) for sent, latency in pairs if latency is not None]

    def duration_s(self) -> float | None:
        """Return the time from the first request's departure to the last answer's arrival."""
        ends = self.arrivals()
        return max(ends) - self.sent_s[0] if ends else None

    def answered_ms(self) -> list[float]:
        """Return the latencies of answered requests in milliseconds, in order of sending."""
        return [latency * MS for _, latency in self._answered()]

    def row(self, name: str) -> Row:
        """Summarise the run; quantiles are over answered requests."""
        answered = self.answered_ms()
        return Row(
            name,
            sent=len(self.latency_s),
            lost=len(self.latency_s) - len(answered),
            p50_ms=quantile(answered, 0.5),
            p99_ms=quantile(answered, 0.99),
            max_ms=max(answered, default=None),
        )


@dataclass(frozen=True, slots=True)
class Row:
    """One run, or the median of several runs of one kind."""

    name: str
    sent: int
    lost: int
    p50_ms: float | None
    p99_ms: float | None
    max_ms: float | None

    @classmethod
    def of_repeats(cls, rows: Sequence[Row]) -> Row:
        """Return the medians of the quantiles, the sums of requests and losses, and the worst of all."""
        return cls(
            rows[0].name,
            sent=sum(row.sent for row in rows),
            lost=sum(row.lost for row in rows),
            p50_ms=median(row.p50_ms for row in rows),
            p99_ms=median(row.p99_ms for row in rows),
            max_ms=worst(row.max_ms for row in rows),
        )
