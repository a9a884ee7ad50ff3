"""Holds what became of every request of a run, and derives its figures: misses first, then latencies.

A request is due when the workload says so; its latency counts from then on, even if its sender was blocked. A request
without an answer after UNANSWERED_S counts as UNANSWERED_S in means and quantiles. Otherwise the worse system would
look better, because only its easy requests would be left.
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field
from typing import TYPE_CHECKING, Any, Self

from bench.dataplane.statistics import MS, quantile

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence
    from pathlib import Path

    Windows = Mapping[str, Mapping[str, "Figures"]]
    """Scenario -> contender -> figures, of runs that are not void."""

UNANSWERED_S = 10.0


@dataclass(frozen=True, slots=True)
class Request:
    """One request; times are seconds from the start of the window."""

    due_s: float
    sent_s: float | None
    """None if never, because its sender was blocked."""
    answered_s: float | None
    """None if never."""

    @property
    def latency_s(self) -> float:
        """Latency since it was due, at most UNANSWERED_S."""
        return UNANSWERED_S if self.answered_s is None else min(UNANSWERED_S, self.answered_s - self.due_s)


@dataclass(frozen=True, slots=True)
class Figures:
    """Figures of one run, or of several together."""

    requests: int
    miss_ratio: float
    """Share of requests without an answer by the deadline."""
    unanswered_ratio: float
    """Share of requests without an answer after UNANSWERED_S."""
    mean_ms: float
    p50_ms: float
    p99_ms: float
    bytes_per_request: float | None
    """Bytes of IP packets that the robot sent, over all its interfaces; None if computed, not run."""

    @property
    def misses(self) -> float:
        """Number of requests that missed the deadline."""
        return self.miss_ratio * self.requests


@dataclass(frozen=True, slots=True)
class Outcome:
    """One contender in one scenario."""

    scenario: str
    case: str
    contender: str
    deadline_ms: float
    requests: tuple[Request, ...]
    bytes_sent: dict[str, int] = field(default_factory=dict)
    """Bytes of IP packets that the robot sent in the window, by interface."""
    disturbances: tuple[str, ...] = ()
    """Why the run is void; empty if it counts."""
    conditions: dict[str, Any] = field(default_factory=dict)
    """How late emulator and client were, how busy the machine was."""

    def figures(self) -> Figures:
        """Return the figures; the run must have requests."""
        latencies = [request.latency_s for request in self.requests]
        count = len(latencies)
        late = sum(latency * MS > self.deadline_ms for latency in latencies)
        return Figures(
            requests=count,
            miss_ratio=late / count,
            unanswered_ratio=sum(latency >= UNANSWERED_S for latency in latencies) / count,
            mean_ms=sum(latencies) / count * MS,
            p50_ms=(quantile(latencies, 0.5) or 0.0) * MS,
            p99_ms=(quantile(latencies, 0.99) or 0.0) * MS,
            bytes_per_request=sum(self.bytes_sent.values()) / count if self.bytes_sent else None,
        )

    def write(self, folder: Path) -> Path:
        """Write it to FOLDER/SCENARIO/CONTENDER.json and return the file."""
        file = folder / self.scenario / f"{self.contender}.json"
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(self.text(), encoding="utf-8")
        return file

    def text(self) -> str:
        """Return what `write` writes, with times to the microsecond."""
        requests = [
            {name: None if at is None else round(at, 6) for name, at in asdict(one).items()} for one in self.requests
        ]
        return json.dumps({**asdict(self), "requests": requests, "figures": asdict(self.figures())}) + "\n"

    @classmethod
    def read(cls, file: Path) -> Self:
        """Read what `write` wrote; raises ValueError, which names the file, if it is not such a file."""
        try:
            fields: dict[str, Any] = json.loads(file.read_text(encoding="utf-8"))
            del fields["figures"]
            fields["requests"] = tuple(Request(**request) for request in fields["requests"])
            fields["disturbances"] = tuple(fields["disturbances"])
            return cls(**fields)
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise ValueError(f"{file}: expected the record of a run, remove it: {error}") from None


def together(runs: Sequence[Outcome]) -> Outcome:
    """Combine all requests of runs with one deadline into one run."""
    sent = sum(sum(run.bytes_sent.values()) for run in runs)
    requests = tuple(request for run in runs for request in run.requests)
    one = runs[0]
    return Outcome("", one.case, one.contender, one.deadline_ms, requests, {"": sent} if sent else {})


def by_window(outcomes: Iterable[Outcome]) -> dict[str, dict[str, Outcome]]:
    """Return scenario -> contender -> run, without void runs."""
    found: dict[str, dict[str, Outcome]] = {}
    for outcome in outcomes:
        if not outcome.disturbances:
            found.setdefault(outcome.scenario, {})[outcome.contender] = outcome
    return found


def figures_by_window(outcomes: Iterable[Outcome]) -> dict[str, dict[str, Figures]]:
    """Scenario -> contender -> figures, of runs that are not void."""
    return {
        scenario: {name: run.figures() for name, run in runs.items()} for scenario, runs in by_window(outcomes).items()
    }
