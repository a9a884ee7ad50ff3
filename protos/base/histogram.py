"""Implements a mergeable latency histogram with logarithmic buckets, the unit of every report.

Layout 1::

    index        0        |   1  ..  340                        |     341
    covers   [0, 0.1 ms)  |   [EDGES[i-1], EDGES[i])            |  [60 s, inf)
                          |   each 3.991 % wider than the last  |

    beside the buckets: `lost`, requests that were never answered

A value reported at the geometric middle of its bucket is off by less than 2 %. Histograms of the same layout merge by
adding counts, which is exact and independent of the order. An earlier state of a histogram that only grew is subtracted
just as exactly. Old samples fade in `plr.controlplane.core.estimate.fading`, where there is a clock to fade by.

A sidecar has no numpy of its own, and an operator's `plr` has none at all. So only the parts that the control plane
computes with import it, at their first use.
"""

from __future__ import annotations

import functools
import itertools
import math
from array import array
from bisect import bisect_right
from operator import lt
from typing import TYPE_CHECKING

from plr.protos.base.errors import DecodeError

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    import numpy as np
    from numpy.typing import ArrayLike, NDArray

LAYOUT = 1
"""Number of the bucket layout above; any other layout gets another number."""

MIN_S = 1e-4
"""Lower edge of the first regular bucket in seconds, below what a request takes over any network."""

MAX_S = 60.0
"""Upper edge of the last regular bucket in seconds, beyond any sensible deadline of a robot."""

REGULAR_BUCKETS = 340
"""The smallest number that keeps the error below 2 % between MIN_S and MAX_S."""

GROWTH = (MAX_S / MIN_S) ** (1.0 / REGULAR_BUCKETS)
"""Ratio of a regular bucket's upper edge to its lower one."""

EDGES: tuple[float, ...] = (
    *(MIN_S * GROWTH**i for i in range(REGULAR_BUCKETS)),
    MAX_S,
)
"""The edges between buckets in seconds: bucket i ends at EDGES[i], and the last has no end."""

BUCKETS = REGULAR_BUCKETS + 2
"""Regular buckets, underflow and overflow."""

MIDS: tuple[float, ...] = (
    MIN_S / 2,
    *(math.sqrt(low * high) for low, high in itertools.pairwise(EDGES)),
    MAX_S,
)
"""The value in seconds that represents a bucket: its geometric middle, or the lower edge of the overflow bucket."""

_EMPTY = bytes(8 * BUCKETS)

MAX_COUNT = 1 << 40
"""Most samples of one histogram accepted from the network: more than any sidecar sends in a lifetime, and far below
where a 64-bit sum or a float would become inexact."""


class Histogram:
    """Counts of latencies by bucket; mutable, and for one thread at a time. Times are in seconds.

    A histogram from the network stays sparse until its buckets are needed: a report has dozens, each with a handful of
    samples.
    """

    __slots__ = ("_counts", "_lost", "_sparse")

    # Mutable: equal by content, so not hashable.
    __hash__ = None  # type: ignore[assignment]  # Python's own way to say so

    def __init__(self) -> None:
        # An integer in an array is incremented twice as fast as in numpy, which computes on the same memory.
        self._counts = array("q", _EMPTY)
        self._lost = 0
        # Tuples of numbers, as the garbage collector skips them, unlike lists.
        self._sparse: tuple[tuple[int, ...], tuple[int, ...]] | None = None
        """The buckets in use and their counts, as long as `_counts` does not exist."""

    if not TYPE_CHECKING:

        def __getattr__(self, name: str) -> array[int]:
            # Python calls this for an empty slot, so that `record` pays nothing for sparse histograms.
            if name != "_counts":
                raise AttributeError(name)
            counts = array("q", _EMPTY)
            for index, count in zip(*self._sparse, strict=True):
                counts[index] = count
            self._counts, self._sparse = counts, None
            return counts

    def record(self, seconds: float) -> None:
        """Count one answered request; negative times (clock noise) count as zero. NaN raises ValueError."""
        # Bisection over the edges runs in C, and is exact at the edges where a logarithm is not.
        if seconds != seconds:
            raise ValueError("a latency is not NaN")
        self._counts[bisect_right(EDGES, seconds)] += 1

    def record_many(self, seconds: ArrayLike) -> None:
        """Count many answered requests, as `record` counts one; if one of them is NaN, count none."""
        import numpy as np

        values = np.asarray(seconds, dtype=np.float64).ravel()
        if np.isnan(values).any():
            raise ValueError("a latency is not NaN")
        self.counts[:] += np.bincount(np.searchsorted(_edges(), values, side="right"), minlength=BUCKETS)

    def record_lost(self, n: int = 1) -> None:
        """Count `n` requests that were never answered."""
        if n < 0:
            raise ValueError("a count is not negative")
        self._lost += n

    def merge(self, other: Histogram) -> None:
        """Add the counts of `other` to this one."""
        counts = self._counts
        for index, added in other._items():
            counts[index] += added
        self._lost += other._lost

    def subtract(self, earlier: Histogram) -> None:
        """Subtract an earlier state, so that only later samples are left.

        Raises ValueError and changes nothing if any count of `earlier` is larger: then it is no earlier state of this
        histogram.
        """
        counts = self._counts
        if self._lost < earlier._lost or any(counts[index] < taken for index, taken in earlier._items()):
            raise ValueError("the histogram to subtract counts what this one does not")
        for index, taken in earlier._items():
            counts[index] -= taken
        self._lost -= earlier._lost

    def copy(self) -> Histogram:
        """Return a separate histogram with the same counts."""
        twin = Histogram()
        twin._counts = self._counts[:]
        twin._lost = self._lost
        return twin

    def clear(self) -> None:
        """Forget everything."""
        self._counts = array("q", _EMPTY)
        self._lost = 0
        self._sparse = None

    def take(self) -> Histogram:
        """Return what was recorded so far, and start again from zero."""
        taken = Histogram()
        taken._counts, taken._lost = self._counts, self._lost
        self.clear()
        return taken

    @property
    def counts(self) -> NDArray[np.int64]:
        """Count of each of the `BUCKETS` buckets; a view, which later records change."""
        import numpy as np

        return np.frombuffer(self._counts, dtype=np.int64)

    @property
    def lost(self) -> int:
        """Number of requests that were never answered."""
        return self._lost

    @property
    def answered(self) -> int:
        """Number of requests that were answered, however late."""
        return sum(self._counts if self._sparse is None else self._sparse[1])

    @property
    def total(self) -> int:
        """Number of all requests, answered or lost."""
        return self.answered + self._lost

    def count_over(self, seconds: float) -> float:
        """Return how many requests took longer than `seconds`, linear inside a bucket; lost ones always count.

        The whole overflow bucket counts as over, as its values are not known.
        """
        index = bisect_right(EDGES, seconds)
        over = float(sum(self._counts[index + 1 :]) + self._lost)
        if index == BUCKETS - 1:
            return over + self._counts[index]
        low = EDGES[index - 1] if index else 0.0
        high = EDGES[index]
        return over + self._counts[index] * min(1.0, (high - seconds) / (high - low))

    def fraction_over(self, seconds: float) -> float:
        """Return the share of all requests that took longer than `seconds`; NaN for an empty histogram."""
        total = self.total
        return self.count_over(seconds) / total if total else math.nan

    def quantile(self, q: float) -> float:
        """Return the latency that a share `q` of all requests does not exceed, within 2 %.

        It is inf where that many were not answered, `MAX_S` in the overflow bucket, and NaN for an empty histogram.
        Raises ValueError unless 0 <= q <= 1.
        """
        if not 0.0 <= q <= 1.0:
            raise ValueError(f"a quantile lies in [0, 1], not {q}")
        total = self.total
        if not total:
            return math.nan
        rank = max(1, math.ceil(q * total))
        up_to = 0
        for index, count in self._items():
            up_to += count
            if up_to >= rank:
                return MIDS[index]
        return math.inf

    def mean(self) -> float:
        """Return the mean latency of the answered requests, within 2 %; NaN if there are none."""
        answered = self.answered
        return self.sum_s() / answered if answered else math.nan

    def sum_s(self) -> float:
        """Return the total time of all answered requests in seconds, within 2 %."""
        return sum(count * MIDS[index] for index, count in self._items())

    @property
    def sparse(self) -> tuple[Sequence[int], Sequence[int]]:
        """Indices of the buckets in use, ascending, and their counts."""
        if self._sparse is not None:
            return self._sparse
        used = list(itertools.compress(range(BUCKETS), self._counts))
        return used, [self._counts[index] for index in used]

    def to_sparse(self) -> tuple[list[int], list[int], int]:
        """Return the ascending indices of the buckets in use, their counts, and the lost."""
        indices, counts = self.sparse
        return list(indices), list(counts), self._lost

    def _items(self) -> Iterator[tuple[int, int]]:
        """Yield the buckets in use, ascending, with their counts."""
        if self._sparse is not None:
            return zip(*self._sparse, strict=True)
        return itertools.compress(enumerate(self._counts), self._counts)

    @classmethod
    def from_sparse(
        cls, indices: Sequence[int], counts: Sequence[int], lost: int, *, layout: int = LAYOUT
    ) -> Histogram:
        """Invert `to_sparse`; raise DecodeError on anything that `to_sparse` cannot have made."""
        if layout != LAYOUT:
            raise DecodeError(f"histogram layout {layout} is not {LAYOUT}")
        if len(indices) != len(counts):
            raise DecodeError(f"histogram has {len(indices)} indices but {len(counts)} counts")
        if not 0 <= lost <= MAX_COUNT:
            raise DecodeError(f"histogram counts {lost} lost, which is not within 0..{MAX_COUNT}")
        indices, counts = tuple(indices), tuple(counts)
        if indices:
            _check_sparse(indices, counts, lost)
        histogram = cls.__new__(cls)
        histogram._sparse = indices, counts
        histogram._lost = lost
        return histogram

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Histogram):
            return NotImplemented
        if self._sparse is not None and other._sparse is not None:
            return self._lost == other._lost and self._sparse == other._sparse
        return self._lost == other._lost and self._counts == other._counts

    def __repr__(self) -> str:
        if not self.total:
            return "Histogram(empty)"
        return (
            f"Histogram(total={self.total}, lost={self._lost}, "
            f"p50={self.quantile(0.5):.4g} s, p99={self.quantile(0.99):.4g} s)"
        )


@functools.cache
def _edges() -> NDArray[np.float64]:
    import numpy as np

    return np.array(EDGES)


def _check_sparse(indices: tuple[int, ...], counts: tuple[int, ...], lost: int) -> None:
    """Check indices and counts, equally many; raise DecodeError on the first that is wrong."""
    ascend = indices[0] >= 0 and indices[-1] < BUCKETS and all(map(lt, indices, indices[1:]))
    if ascend and min(counts) >= 1 and sum(counts) + lost <= MAX_COUNT:
        return
    previous = -1
    for index, count in zip(indices, counts, strict=True):
        if not previous < index < BUCKETS:
            raise DecodeError(f"histogram index {index} does not follow {previous} within 0..{BUCKETS - 1}")
        if not 1 <= count <= MAX_COUNT:
            raise DecodeError(f"histogram count {count} is not within 1..{MAX_COUNT}")
        previous = index
    raise DecodeError(f"histogram counts {sum(counts) + lost} samples, more than {MAX_COUNT}")
