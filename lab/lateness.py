"""Keeps a histogram of how late something happened, cheap enough to update per packet."""

from __future__ import annotations

from typing import Any

# Sub-buckets per doubling: 32 keeps a quantile within 1/32 (3 %) of the truth.
_SUB_BITS = 5
_SUB = 1 << _SUB_BITS
# Microseconds; the last bucket takes all above ~67 s.
_MAX_US = (1 << 26) - 1
_BUCKETS = ((26 - _SUB_BITS - 1) << _SUB_BITS) + 2 * _SUB


class LatenessHistogram:
    """Log-linear histogram of durations from 1 microsecond to a minute."""

    __slots__ = ("_counts", "count", "max_s")

    def __init__(self) -> None:
        self.count = 0
        self.max_s = 0.0
        self._counts = [0] * _BUCKETS

    def record(self, seconds: float) -> None:
        """Count one duration; negative ones count as 0."""
        us = int(seconds * 1e6)
        if us < 0:
            us = 0
        elif us > _MAX_US:
            us = _MAX_US
        shift = us.bit_length() - _SUB_BITS - 1
        if shift <= 0:
            self._counts[us] += 1
        else:
            self._counts[(shift << _SUB_BITS) + (us >> shift)] += 1
        self.count += 1
        if seconds > self.max_s:
            self.max_s = seconds

    def quantile(self, q: float) -> float:
        """Return the upper bound, in seconds, of the bucket with the `q` quantile; 0 if nothing was recorded."""
        if self.count == 0:
            return 0.0
        rank = max(1, min(self.count, round(q * self.count)))
        seen = 0
        for index, count in enumerate(self._counts):
            seen += count
            if seen >= rank:
                return min(_upper_bound_us(index) / 1e6, self.max_s)
        return self.max_s

    def to_json(self) -> dict[str, Any]:
        """Return count, p50_s, p99_s, max_s."""
        return {
            "count": self.count,
            "p50_s": self.quantile(0.5),
            "p99_s": self.quantile(0.99),
            "max_s": self.max_s,
        }


def _upper_bound_us(index: int) -> int:
    if index < 2 * _SUB:
        return index + 1
    shift = (index >> _SUB_BITS) - 1
    return (index - (shift << _SUB_BITS) + 1) << shift
