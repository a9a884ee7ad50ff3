"""Made-up records of runs."""

from __future__ import annotations

from typing import Any

from bench.evaluation.outcome import Outcome, Request

DRIVE = "a-drive-one-two-01-at-30"


def run(
    contender: str,
    *,
    scenario: str = DRIVE,
    case: str = "A",
    late: int = 0,
    late_s: float = 2.0,
    usual_s: float = 0.1,
    megabytes: int = 0,
    void: bool = False,
    **conditions: Any,
) -> Outcome:
    """A hundred requests, the first of them late."""
    requests = tuple(Request(float(n), float(n), n + (late_s if n < late else usual_s)) for n in range(100))
    sent = {"wlan0": megabytes * 1_000_000} if megabytes else {}
    return Outcome(scenario, case, contender, 1000.0, requests, sent, ("busy",) if void else (), conditions)


def drive(number: int = 1, *, direct: int = 20, ours: int = 1, ideal: int = 1, **ours_is: Any) -> list[Outcome]:
    """A recorded drive: so many late requests of each."""
    scenario = f"a-drive-one-two-{number:02}-at-30"
    late = {"direct-a": direct * 2, "direct-b": direct, "ideal": ideal, "ideal-a": direct, "ideal-b": ideal}
    runs = [run(name, scenario=scenario, late=count) for name, count in late.items()]
    return [*runs, run("plr-replicate", scenario=scenario, late=ours, **ours_is)]
