"""Samples memory and threads of the system's processes over time, and judges whether they grow."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from bench.churn.machine import processor_s

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from lab.system import Part

MAX_GROWTH_MB = 4.0
"""Tolerated growth over the second half of a run, by a straight line through the minimum of each minute, less twice its
standard error. It is above the allocator's steps and far below a leak of one object for each request of ten minutes.
Answers of 16 MB come and go, so the minimum counts: what remains between them is what adds up."""
LEAST_OF_S = 60.0
MAX_MORE_THREADS = 2
"""Tolerated growth in threads: gRPC starts and ends threads of its own."""
MIN_JUDGED_S = 120.0
"""A second half shorter than this consists of warming up: imports, caches, arenas."""


@dataclass(frozen=True, slots=True)
class Sample:
    """One process at one moment, `at_s` seconds into the run."""

    at_s: float
    rss_mb: float
    threads: int
    processor_s: float = 0.0
    """Processor time used since the process began."""


@dataclass(slots=True)
class Life:
    """One process from its first sample to its last; a program that is restarted has several."""

    name: str
    pid: int
    samples: list[Sample] = field(default_factory=list)

    def near(self, at_s: float, tolerance_s: float) -> Sample | None:
        """Return the sample closest to a moment, if there is one within the tolerance."""
        nearest = min(self.samples, key=lambda sample: abs(sample.at_s - at_s))
        return nearest if abs(nearest.at_s - at_s) <= tolerance_s else None


@dataclass(frozen=True, slots=True)
class Growth:
    """How a process grew over the second half of a run."""

    name: str
    span_s: float
    rss_mb: float
    """Growth by a straight line through the minimum of each minute ..."""
    rss_error_mb: float
    """... and twice the standard error of that."""
    threads: int
    """By how much the maximum in the last quarter exceeds that in the third."""
    judged: bool
    """Whether it ran through the whole second half, and that was long enough to judge."""

    @property
    def grows(self) -> bool:
        """Whether it is judged to leak."""
        return self.judged and (self.rss_mb - self.rss_error_mb > MAX_GROWTH_MB or self.threads > MAX_MORE_THREADS)


class Watch:
    """Takes samples of the running parts."""

    def __init__(self) -> None:
        self.lives: list[Life] = []

    def take(self, at_s: float, parts: Mapping[str, Part]) -> None:
        """Sample the processes that are running now."""
        for name, part in parts.items():
            pid = part.process.inner_pid if part.process.poll() is None else None
            read = None if pid is None else _read(pid)
            if pid is None or read is None:
                continue
            life = next((life for life in self.lives if life.pid == pid and life.name == name), None)
            if life is None:
                life = Life(name, pid)
                self.lives.append(life)
            life.samples.append(Sample(at_s, *read, processor_s(pid)))

    def growths(self, length_s: float, every_s: float) -> list[Growth]:
        """Return the growth of the processes alive at the end of a run of `length_s`, sampled every `every_s`."""
        last = max((sample.at_s for life in self.lives for sample in life.samples), default=0.0)
        newest = {life.name: life for life in self.lives if life.samples[-1].at_s >= last - 2 * every_s}
        return [growth(life, length_s, every_s) for life in newest.values()]


def growth(life: Life, length_s: float, every_s: float) -> Growth:
    """Return how one process grew over the second half of a run of `length_s`."""
    half = [sample for sample in life.samples if sample.at_s >= length_s / 2]
    if len(half) < 3:
        return Growth(life.name, 0.0, 0.0, 0.0, 0, judged=False)
    span_s = half[-1].at_s - half[0].at_s
    whole = half[0].at_s <= length_s / 2 + 2 * every_s
    least: dict[int, float] = {}
    for sample in half:
        minute = int(sample.at_s // LEAST_OF_S)
        least[minute] = min(sample.rss_mb, least.get(minute, math.inf))
    slope, error = slope_of([(minute * LEAST_OF_S, rss_mb) for minute, rss_mb in least.items()])
    # Threads come and go with connections: growth shows as a higher peak.
    middle = len(half) // 2
    threads = max(sample.threads for sample in half[middle:]) - max(sample.threads for sample in half[:middle])
    return Growth(
        life.name,
        span_s,
        slope * span_s,
        2 * error * span_s,
        threads,
        judged=whole and span_s >= MIN_JUDGED_S - 2 * every_s,
    )


def slope_of(points: Sequence[tuple[float, float]]) -> tuple[float, float]:
    """Return the slope of the least-squares line, and its standard error."""
    count = len(points)
    mean_x = sum(x for x, _ in points) / count
    mean_y = sum(y for _, y in points) / count
    spread = sum((x - mean_x) ** 2 for x, _ in points)
    if not spread:
        return 0.0, 0.0
    slope = sum((x - mean_x) * (y - mean_y) for x, y in points) / spread
    rest = sum((y - mean_y - slope * (x - mean_x)) ** 2 for x, y in points)
    return slope, math.sqrt(rest / (count - 2) / spread) if count > 2 else 0.0


def _read(pid: int) -> tuple[float, int] | None:
    try:
        lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    except OSError:
        return None
    fields = dict(line.split(":", 1) for line in lines if ":" in line)
    if "VmRSS" not in fields:
        return None  # it is ending
    return int(fields["VmRSS"].split()[0]) / 1024, int(fields["Threads"])
