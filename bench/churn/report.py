"""Judges a run, and writes a report of it."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field
from typing import TYPE_CHECKING, Any

from rich.table import Table

from bench.churn.schedule import Kind

if TYPE_CHECKING:
    from pathlib import Path

    from rich.console import Console

    from bench.churn.machine import Load
    from bench.churn.runner import Done
    from bench.churn.samples import Growth, Life

QUARTERS = (0.0, 0.25, 0.5, 0.75, 1.0)
FLAWS = ("missing", "answered_twice", "invalid", "strangers")
"""Keys of a client's summary that must be 0."""


@dataclass(slots=True)
class Outcome:
    """Everything known after a run."""

    seed: int
    length_s: float
    clients: dict[str, dict[str, Any]]
    """Summary of each client: sent, answered once, missing, twice, ..."""
    done: list[Done]
    postponed_s: dict[str, float]
    lives: list[Life]
    growths: list[Growth]
    loads: list[Load]
    failures: list[str] = field(default_factory=list)

    def verdicts(self) -> list[str]:
        """Return why the run failed; empty if it did not."""
        found = list(self.failures)
        for client, summary in self.clients.items():
            found += [f"{client}: {summary[flaw]} requests {flaw.replace('_', ' ')}" for flaw in FLAWS if summary[flaw]]
            if not summary["sent"]:
                found.append(f"{client}: nothing was sent")
        for growth in self.growths:
            if growth.grows:
                grown = f"{growth.rss_mb:.1f} ± {growth.rss_error_mb:.1f} MB and {growth.threads} threads"
                found.append(f"{growth.name} grew by {grown} in {growth.span_s:.0f} s")
        return found


def recovery(done: list[Done]) -> dict[str, list[float]]:
    """Return, by kind of trouble, the sorted seconds from its end until the resource was seen in use again."""
    times: dict[str, list[float]] = {}
    for entry in done:
        if entry.back_s is not None and entry.ended_s is not None:
            times.setdefault(entry.trouble.kind.value, []).append(entry.back_s - entry.ended_s)
    return {kind.value: sorted(times[kind.value]) for kind in Kind if kind.value in times}


def write_json(path: Path, outcome: Outcome) -> None:
    """Write everything for programs to read."""
    content = {
        "seed": outcome.seed,
        "length_s": outcome.length_s,
        "passed": not outcome.verdicts(),
        "verdicts": outcome.verdicts(),
        "clients": outcome.clients,
        "postponed_s": outcome.postponed_s,
        "recovery_s": recovery(outcome.done),
        "growth": [{**asdict(growth), "grows": growth.grows} for growth in outcome.growths],
        "machine": [asdict(load) for load in outcome.loads],
        "lives": [asdict(life) for life in outcome.lives],
        "timeline": [asdict(entry) for entry in outcome.done],
    }
    path.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


def show(console: Console, outcome: Outcome) -> None:
    """Print the same for people."""
    console.print(_requests(outcome))
    console.print(_recovery(outcome))
    console.print(_processes(outcome))
    console.print(_machine(outcome.loads))
    verdicts = outcome.verdicts()
    for verdict in verdicts:
        console.print(f"[red]failed: {verdict}[/red]")
    if not verdicts:
        console.print("[green]no request lost, none answered twice, nothing grows[/green]")


def _requests(outcome: Outcome) -> Table:
    table = Table(title="requests, answered while at least one path and one server were well")
    for column in ("client", "sent", "once", "lost", "twice", "wrong", "late", "P50 ms", "P99", "worst"):
        table.add_column(column, justify="left" if column == "client" else "right")
    for name, summary in outcome.clients.items():
        latencies = [summary[key] for key in ("p50_ms", "p99_ms", "max_ms")]
        table.add_row(
            name,
            *(str(summary[key]) for key in ("sent", "answered_once", "missing", "answered_twice")),
            str(summary["invalid"] + summary["strangers"]),
            str(summary["deadline_missed"] - summary["missing"]),
            *("-" if value is None else f"{value:.0f}" for value in latencies),
        )
    return table


def _recovery(outcome: Outcome) -> Table:
    table = Table(title="from the end of a trouble until seen in use again")
    for column in ("trouble", "times", "median s", "worst s"):
        table.add_column(column, justify="left" if column == "trouble" else "right")
    for kind, times in recovery(outcome.done).items():
        table.add_row(kind, str(len(times)), f"{times[len(times) // 2]:.1f}", f"{times[-1]:.1f}")
    return table


def _machine(loads: list[Load]) -> str:
    """Return one line on the load: other users of the machine may be the reason for delays."""
    if not loads:
        return "nothing is known of the machine"
    parts = [("busy", [load.busy for load in loads]), ("stolen", [load.stolen for load in loads])]
    waiting = [load.waiting for load in loads if load.waiting is not None]
    if waiting:
        parts.append(("somebody waits for one", waiting))
    shares = (f"{name} {sum(each) / len(each):.0%}, at worst {max(each):.0%}" for name, each in parts)
    return f"processors: {'; '.join(shares)}"


def _processes(outcome: Outcome) -> Table:
    table = Table(title="MB of memory / threads of what ran at the end")
    quarters = [f"{share:.0%}" for share in QUARTERS]
    for column in ("process", *quarters, "2nd half", ""):
        table.add_column(column, justify="left" if column == "process" else "right")
    tolerance_s = outcome.length_s / 16 + 5.0
    for growth in outcome.growths:
        life = [life for life in outcome.lives if life.name == growth.name][-1]
        samples = [life.near(share * outcome.length_s, tolerance_s) for share in QUARTERS]
        verdict = "grows" if growth.grows else "steady" if growth.judged else "too short"
        table.add_row(
            growth.name,
            *("-" if sample is None else f"{sample.rss_mb:.0f}/{sample.threads}" for sample in samples),
            f"{growth.rss_mb:+.1f}±{growth.rss_error_mb:.1f}/{growth.threads:+d}",
            verdict,
        )
    return table
