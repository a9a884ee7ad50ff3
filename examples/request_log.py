"""What became of every request of a run: answered once, never or twice, how fast, and with the right answer."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from pathlib import Path


@dataclass(slots=True)
class RequestRecord:
    """One request. Times are in seconds; `sent_s` is monotonic, `sent_wall_s` since the epoch."""

    index: int
    sent_s: float
    sent_wall_s: float
    answers: int = 0
    latency_ms: float | None = None
    problem: str | None = None
    detail: dict[str, float] | None = None

    @property
    def valid(self) -> bool:
        """Whether an answer came and belonged to this request."""
        return self.answers > 0 and self.problem is None

    def as_json(self) -> dict[str, Any]:
        """This record as JSON-ready values."""
        return {
            "index": self.index,
            "sent_s": self.sent_s,
            "sent_wall_s": self.sent_wall_s,
            "latency_ms": self.latency_ms,
            "answered": self.answers > 0,
            "answers": self.answers,
            "valid": self.valid,
            "problem": self.problem,
            **(self.detail or {}),
        }


class RequestLog:
    """Records of one run against one service."""

    def __init__(self, service: str, deadline_ms: float) -> None:
        self.service = service
        self.deadline_ms = deadline_ms
        self.records: list[RequestRecord] = []
        # Answers that belong to no request of this run.
        self.strangers = 0

    def sent(self, now: float, wall: float) -> RequestRecord:
        """Open the record of a request that goes out now."""
        record = RequestRecord(len(self.records), now, wall)
        self.records.append(record)
        return record

    def answered(self, record: RequestRecord, now: float) -> None:
        """Count one answer. The first one settles the latency."""
        record.answers += 1
        if record.answers == 1:
            record.latency_ms = (now - record.sent_s) * 1e3

    @property
    def missing(self) -> int:
        """Requests without an answer so far."""
        return sum(record.answers == 0 for record in self.records)

    def summary(self) -> dict[str, Any]:
        """Counts and latency figures of all requests so far. A request without an answer missed its deadline."""
        latencies = sorted(record.latency_ms for record in self.records if record.latency_ms is not None)
        in_time = sum(latency <= self.deadline_ms for latency in latencies)
        sent = len(self.records)
        return {
            "sent": sent,
            "answered_once": sum(record.answers == 1 for record in self.records),
            "missing": self.missing,
            "answered_twice": sum(record.answers > 1 for record in self.records),
            "strangers": self.strangers,
            "invalid": sum(record.answers > 0 and record.problem is not None for record in self.records),
            "deadline_missed": sent - in_time,
            "deadline_miss_ratio": (sent - in_time) / sent if sent else 0.0,
            "mean_ms": sum(latencies) / len(latencies) if latencies else None,
            "p50_ms": quantile(latencies, 0.50),
            "p99_ms": quantile(latencies, 0.99),
            "max_ms": latencies[-1] if latencies else None,
        }

    def flawless(self) -> bool:
        """Whether every request was answered exactly once, with its own answer."""
        summary = self.summary()
        return summary["answered_once"] == summary["sent"] > 0 and not summary["invalid"] + summary["strangers"]

    def progress(self, elapsed_s: float, since_s: float) -> str:
        """One line for a person who watches; latencies are of the requests sent after `since_s` (monotonic)."""
        recent = sorted(
            record.latency_ms for record in self.records if record.sent_s >= since_s and record.latency_ms is not None
        )
        p50, worst = quantile(recent, 0.5), recent[-1] if recent else None
        summary = self.summary()
        return (
            f"{elapsed_s:6.1f} s  sent {summary['sent']:5d}  unanswered {summary['missing']:3d}"
            f"  twice {summary['answered_twice']:2d}  wrong {summary['invalid']:2d}"
            f"  late {summary['deadline_missed'] - summary['missing']:3d}"
            f"  last second: median {milliseconds(p50)}, worst {milliseconds(worst)}"
        )

    def write_json(self, path: Path) -> None:
        """Write the summary and every record."""
        content = {
            "service": self.service,
            "deadline_ms": self.deadline_ms,
            "summary": self.summary(),
            "requests": [record.as_json() for record in self.records],
        }
        path.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


def quantile(ordered: list[float], fraction: float) -> float | None:
    """The smallest value that at least `fraction` of the ordered values do not exceed; None of no values."""
    if not ordered:
        return None
    return ordered[max(0, math.ceil(fraction * len(ordered)) - 1)]


def milliseconds(value: float | None) -> str:
    """A latency for people."""
    return "   -   " if value is None else f"{value:5.1f} ms"
