"""What became of every request of a run, and the figures that follow: misses first, then latencies.

A request is due when the workload says so; from then on its latency counts, also when its sender was blocked. Whoever
has no answer after UNANSWERED_S counts as UNANSWERED_S in means and quantiles: else the worse system looks better,
because only its easy requests are left.
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
    """One request; seconds from the window's begin."""

    due_s: float
    sent_s: float | None
    """None: never, its sender was blocked."""
    answered_s: float | None
    """None: never."""

    @property
    def latency_s(self) -> float:
        """From when it was due, UNANSWERED_S at most."""
        return UNANSWERED_S if self.answered_s is None else min(UNANSWERED_S, self.answered_s - self.due_s)


@dataclass(frozen=True, slots=True)
class Figures:
    """Of one run, or of several together."""

    requests: int
    miss_ratio: float
    """Share that had no answer by the deadline."""
    unanswered_ratio: float
    """Share that had none after UNANSWERED_S."""
    mean_ms: float
    p50_ms: float
    p99_ms: float
    bytes_per_request: float | None
    """Bytes of IP packets that the robot sent, over all its interfaces; None: computed, not run."""

    @property
    def misses(self) -> float:
        """How many requests."""
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
    """Of IP packets that the robot sent in the window, by interface."""
    disturbances: tuple[str, ...] = ()
    """Why the run is void; nothing: it counts."""
    conditions: dict[str, Any] = field(default_factory=dict)
    """How late emulator and client were, how busy the machine was."""

    def figures(self) -> Figures:
        """The figures; the run must have requests."""
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
        """Write it to FOLDER/SCENARIO/CONTENDER.json; returns the file."""
        file = folder / self.scenario / f"{self.contender}.json"
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(self.text(), encoding="utf-8")
        return file

    def text(self) -> str:
        """What `write` writes; times to the microsecond."""
        requests = [
            {name: None if at is None else round(at, 6) for name, at in asdict(one).items()} for one in self.requests
        ]
        return json.dumps({**asdict(self), "requests": requests, "figures": asdict(self.figures())}) + "\n"

    @classmethod
    def read(cls, file: Path) -> Self:
        """The inverse of `write`. Raises ValueError: not such a file; names it."""
        try:
            fields: dict[str, Any] = json.loads(file.read_text(encoding="utf-8"))
            del fields["figures"]
            fields["requests"] = tuple(Request(**request) for request in fields["requests"])
            fields["disturbances"] = tuple(fields["disturbances"])
            return cls(**fields)
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise ValueError(f"{file}: expected the record of a run, remove it: {error}") from None


def together(runs: Sequence[Outcome]) -> Outcome:
    """All requests of runs with one deadline, as one run."""
    sent = sum(sum(run.bytes_sent.values()) for run in runs)
    requests = tuple(request for run in runs for request in run.requests)
    one = runs[0]
    return Outcome("", one.case, one.contender, one.deadline_ms, requests, {"": sent} if sent else {})


def by_window(outcomes: Iterable[Outcome]) -> dict[str, dict[str, Outcome]]:
    """Scenario -> contender -> run, without the void ones."""
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
