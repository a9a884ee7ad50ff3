"""From requests to figures: quantiles, medians of repeats, rows of a table. None stands for what was not measured."""

from __future__ import annotations

import math
import statistics
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Self

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

MS = 1000.0


def quantile(values: Iterable[float], fraction: float) -> float | None:
    """The smallest value that at least `fraction` of the values do not exceed; None of no values."""
    ordered = sorted(values)
    return ordered[max(0, math.ceil(fraction * len(ordered)) - 1)] if ordered else None


def median(values: Iterable[float | None]) -> float | None:
    """Median of what was measured; None when nothing was."""
    known = [value for value in values if value is not None]
    return statistics.median(known) if known else None


def geometric_mean(values: Iterable[float | None]) -> float | None:
    """Geometric mean of what was measured; None when nothing was, or something is not above zero."""
    known = [value for value in values if value is not None]
    return statistics.geometric_mean(known) if known and min(known) > 0 else None


def ratio(one: float | None, other: float | None) -> float | None:
    """`one` over `other`; None unless both were measured and `other` is above zero."""
    return one / other if one is not None and other else None


def difference(one: float | None, other: float | None) -> float | None:
    """`one` minus `other`; None unless both were measured."""
    return one - other if one is not None and other is not None else None


def worst(values: Iterable[float | None]) -> float | None:
    """Largest of what was measured; None when nothing was."""
    return max((value for value in values if value is not None), default=None)


@dataclass(frozen=True, slots=True)
class Calls:
    """A run of requests in order of sending."""

    sent_s: tuple[float, ...]
    """CLOCK_MONOTONIC."""
    latency_s: tuple[float | None, ...]
    """None: no answer came."""

    @classmethod
    def of(cls, fields: dict[str, Any]) -> Self:
        """Read what `CallLog.as_json` wrote."""
        return cls(tuple(fields["sent_s"]), tuple(fields["latency_s"]))

    def between(self, start_s: float, end_s: float = math.inf) -> Calls:
        """Only those sent in this stretch."""
        kept = [pair for pair in zip(self.sent_s, self.latency_s, strict=True) if start_s <= pair[0] < end_s]
        return Calls(tuple(sent for sent, _ in kept), tuple(latency for _, latency in kept))

    def arrivals(self) -> list[float]:
        """When the answers came."""
        return [sent + latency for sent, latency in self._answered()]

    def line(self, zero_s: float) -> list[tuple[float, float]]:
        """For a plot: seconds after `zero_s` and latency in milliseconds of each answered request."""
        return [(sent - zero_s, latency * MS) for sent, latency in self._answered()]

    def _answered(self) -> list[tuple[float, float]]:
        pairs = zip(self.sent_s, self.latency_s, strict=True)
        return [(sent, latency) for sent, latency in pairs if latency is not None]

    def duration_s(self) -> float | None:
        """From the first request's departure to the last answer's arrival."""
        ends = self.arrivals()
        return max(ends) - self.sent_s[0] if ends else None

    def row(self, name: str) -> Row:
        """Summarise; quantiles are over the answered ones."""
        answered = [latency * MS for _, latency in self._answered()]
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
        """Medians of the quantiles, the sums of requests and losses, the worst of all."""
        return cls(
            rows[0].name,
            sent=sum(row.sent for row in rows),
            lost=sum(row.lost for row in rows),
            p50_ms=median(row.p50_ms for row in rows),
            p99_ms=median(row.p99_ms for row in rows),
            max_ms=worst(row.max_ms for row in rows),
        )
