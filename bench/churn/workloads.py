"""Defines the requests of a run: frequent small ones, large answers, and a slow server."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True, slots=True)
class Service:
    """One service of every cloud, each in a process of its own: a slow one must not hold up the others."""

    name: str
    deadline_ms: int
    lifetime_ms: int
    takes_ms: int = 0
    """How long the server sleeps before it answers, one request after the other."""

    @property
    def part(self) -> str:
        """Suffix of its servers' names."""
        return self.name.removeprefix("/")

    def rule(self) -> dict[str, Any]:
        """Return the robot's configuration of the service."""
        return {
            "name": self.name,
            "deadline_ms": self.deadline_ms,
            "lifetime_ms": self.lifetime_ms,
            "idempotent": True,
        }


@dataclass(frozen=True, slots=True)
class Workload:
    """One client."""

    title: str
    part: str
    """The name of its process."""
    service: Service
    rate_hz: float
    size: int
    """Bytes of a request."""
    answer_bytes: tuple[int, int] = (0, 0)
    """Least and most bytes requested back besides the echo's own, each order of magnitude equally likely."""

    @property
    def grace_s(self) -> float:
        """Time after the last request by which every one is answered or has failed."""
        return self.service.lifetime_ms / 1e3 + 5.0

    def argv(self, length_s: float) -> list[str]:
        """Return the arguments of its program, without the destination of the result."""
        argv = ["-m", "lab.echo", "call", "--service", self.service.name, "--size", str(self.size)]
        argv += ["--answer-bytes", *map(str, self.answer_bytes)]
        argv += ["--rate", str(self.rate_hz), "--duration", str(length_s)]
        argv += ["--deadline-ms", str(self.service.deadline_ms), "--grace-s", str(self.grace_s)]
        return [*argv, "--queue-depth", "200"]


ECHO = Service("/echo", deadline_ms=500, lifetime_ms=30_000)
LARGE = Service("/large", deadline_ms=10_000, lifetime_ms=60_000)
SLOW = Service("/slow", deadline_ms=4_000, lifetime_ms=60_000, takes_ms=1_500)
SERVICES = (ECHO, LARGE, SLOW)
MB = 1_000_000
WORKLOADS = (
    Workload("1 kB at 20 Hz", "client-1kb", ECHO, rate_hz=20.0, size=1_000),
    Workload("100 kB at 2 Hz", "client-100kb", ECHO, rate_hz=2.0, size=100_000),
    # 5 MB on average from each server, or 2 MB/s; the two links together carry 11 MB/s, the worse one 4.
    Workload("answers of 1 to 16 MB", "client-large", LARGE, rate_hz=0.2, size=1_000, answer_bytes=(MB, 16 * MB)),
    Workload("a server of 1.5 s", "client-slow", SLOW, rate_hz=0.4, size=1_000),
)
