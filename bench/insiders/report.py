"""Judges a run, and writes a report of it."""

from __future__ import annotations

import json
import re
from dataclasses import asdict, dataclass, field
from typing import TYPE_CHECKING, Any, NamedTuple, Self

from bench.churn.report import FLAWS
from bench.churn.samples import Life, Sample, growth
from bench.dataplane.statistics import Calls, interval, p99_ratio, quantile
from bench.insiders.counted import COUNTED, INTERESTING
from bench.insiders.stage import CLOUDS, PROFILES, ROBOTS
from bench.reporting.machine import machine
from bench.reporting.tables import Table
from bench.reporting.terminal import rich_table
from lab.attacker.hostile_link import spoofed
from plr.sidecar.core.link.path_table import UNPROVEN_BYTES, UNPROVEN_BYTES_PER_S

if TYPE_CHECKING:
    from pathlib import Path

    from rich.console import Console

    from bench.churn.machine import Load
    from bench.churn.samples import Growth
    from bench.insiders.stage import Workload

# The limits. Those of latency and of spoofed bytes were written down before the first run. What may be sent to
# addresses that a member announces was added after it, as in limits.md, because the third party is among them.
MAX_P99_RATIO = 1.5
"""P99 while attacked over P99 undisturbed, for each client."""
MAX_THIRD_PARTY_RATIO = 3.0
"""Bytes that reach the third party over those that the insiders sent in its name (RFC 9000 section 8.1), besides what
each honest interface may send to addresses that a peer announces and has not proven (docs/operate/limits.md)."""
UNPROVEN_LINKS = len(ROBOTS) * len(PROFILES) + len(CLOUDS)
"""Honest interfaces, each of which knows one of the insiders."""
SETTLE_S = 3.0
"""Requests sent within this time of the start or end of the attack count in neither phase."""
MIN_SAMPLES = 200
"""Least number of requests for a P99."""

BAD_LINES = (b"Traceback", b"internal error")
_CONTROL_CHARACTERS = re.compile(rb"[\x00-\x08\x0b-\x1f\x7f]|\xc2[\x80-\x9f]|\xe2\x80[\xaa-\xae]")


class Phase(NamedTuple):
    """A period of the run, in CLOCK_MONOTONIC."""

    began_s: float
    ended_s: float

    @property
    def length_s(self) -> float:
        """Length in seconds."""
        return self.ended_s - self.began_s

    def of(self, calls: Calls) -> list[float]:
        """Return the latencies of requests sent well within it, ms."""
        return calls.between(self.began_s + SETTLE_S, self.ended_s - SETTLE_S).answered_ms()


@dataclass(frozen=True, slots=True)
class Records:
    """The records of one client."""

    summary: dict[str, Any]
    calls: Calls

    @classmethod
    def of(cls, content: dict[str, Any]) -> Self:
        """Read the content of its file."""
        requests = content["requests"]
        latencies = tuple(None if one["latency_ms"] is None else one["latency_ms"] / 1e3 for one in requests)
        return cls(content["summary"], Calls(tuple(one["sent_s"] for one in requests), latencies))


@dataclass(slots=True)
class Outcome:
    """Everything known after a run."""

    before: Phase
    attacked: Phase
    after: Phase
    records: dict[Workload, Records]
    tallies: dict[str, dict[str, list[int]]]
    counted: dict[str, float]
    """Growth of each `host/series` during the attack."""
    third_party_bytes: int
    insiders_s: dict[str, float]
    """Processor time of each insider during the attack."""
    lives: list[Life]
    zero_s: float
    loads: list[Load]
    failures: list[str] = field(default_factory=list)

    def quiet(self, workload: Workload) -> list[float]:
        """Return the latencies before and after the attack, ms."""
        calls = self.records[workload].calls
        return self.before.of(calls) + self.after.of(calls)

    def troubled(self, workload: Workload) -> list[float]:
        """Return the latencies while attacked, ms."""
        return self.attacked.of(self.records[workload].calls)

    def ratio(self, workload: Workload) -> float | None:
        """Return the P99 while attacked over undisturbed; None if there were too few requests."""
        quiet, troubled = self.quiet(workload), self.troubled(workload)
        return p99_ratio(troubled, quiet) if min(len(quiet), len(troubled)) >= MIN_SAMPLES else None

    def attacks(self) -> dict[str, list[int]]:
        """Return runs, messages and bytes of each attack, over all insiders."""
        sums: dict[str, list[int]] = {}
        for tally in self.tallies.values():
            for attack, counts in tally.items():
                before = sums.get(attack, [0, 0, 0])
                sums[attack] = [one + other for one, other in zip(before, counts, strict=True)]
        return dict(sorted(sums.items()))

    def growths(self) -> list[Growth]:
        """Return how the honest programs grew over the second half of the attack."""
        began = self.attacked.began_s - self.zero_s
        length_s = self.attacked.length_s
        found = []
        for life in self.lives:
            samples = [
                Sample(one.at_s - began, one.rss_mb, one.threads, one.processor_s)
                for one in life.samples
                if began <= one.at_s <= began + length_s
            ]
            if samples:
                found.append(growth(Life(life.name, life.pid, samples), length_s, 5.0))
        return found

    def requests_verdicts(self) -> list[str]:
        """Return what is wrong with the honest robots' requests, apart from latencies."""
        found = []
        for workload, records in self.records.items():
            summary = records.summary
            found += [f"{workload.title}: {summary[flaw]} {flaw.replace('_', ' ')}" for flaw in FLAWS if summary[flaw]]
            if not summary["sent"]:
                found.append(f"{workload.title}: nothing was sent")
        return [*self.failures, *found]

    def verdicts(self) -> list[str]:
        """Return why the run failed; empty if it did not."""
        found = self.requests_verdicts()
        for workload in self.records:
            ratio = self.ratio(workload)
            if ratio is not None and ratio > MAX_P99_RATIO:
                found.append(f"{workload.title}: P99 is {ratio:.2f} times that of undisturbed, over {MAX_P99_RATIO}")
        for one in self.growths():
            if one.grows:
                grown = f"{one.rss_mb:.1f} ± {one.rss_error_mb:.1f} MB and {one.threads} threads"
                found.append(f"{one.name} grew by {grown} in {one.span_s:.0f} s")
        limit = self.third_party_limit()
        if self.third_party_bytes > limit:
            found.append(f"{self.third_party_bytes} bytes reached the third party, over {limit:.0f}")
        return found

    def third_party_limit(self) -> float:
        """Return how many bytes may reach the third party."""
        in_its_name = sum(self.attacks().get(attack, [0, 0, 0])[2] for attack in spoofed())
        length_s = self.after.ended_s - self.attacked.began_s
        looked_at = UNPROVEN_LINKS * (UNPROVEN_BYTES + UNPROVEN_BYTES_PER_S * length_s)
        return MAX_THIRD_PARTY_RATIO * in_its_name + looked_at


def flaws_of_log(name: str, log: bytes) -> list[str]:
    """Return lines that no program should write, and characters that no log should contain."""
    lines = log.splitlines()
    found = [f"{name}: {line.decode(errors='replace')}" for line in lines if any(bad in line for bad in BAD_LINES)]
    return found + [f"{name}: control characters in {line!r}" for line in lines if _CONTROL_CHARACTERS.search(line)]


def counted_for(attack: str, counted: dict[str, float]) -> str:
    """Return what the honest programs counted of an attack."""
    parts = []
    for pattern in COUNTED.get(attack, ()):
        value = sum(value for series, value in counted.items() if pattern in _short(series))
        parts.append(f"{pattern} {value:.0f}")
    return ", ".join(parts)


def _short(series: str) -> str:
    """Return `plr_x_total{reason="y"}` as `x y`, whatever the other labels."""
    name, _, labels = series.partition("/")[2].partition("{")
    reason = re.search(r'(?:reason|result|code|resource|outcome)="([^"]*)"', labels)
    return f"{name.removeprefix('plr_').removesuffix('_total')} {reason[1] if reason else ''}".strip()


def tables(outcome: Outcome) -> list[Table]:
    """Return everything as tables."""
    return [_requests(outcome), _attacks(outcome), _refused(outcome), _processes(outcome)]


def _requests(outcome: Outcome) -> Table:
    rows: list[tuple[str | float | int | None, ...]] = []
    for workload, records in outcome.records.items():
        quiet, troubled, summary = outcome.quiet(workload), outcome.troubled(workload), records.summary
        between = interval(p99_ratio, troubled, quiet)
        rows.append(
            (
                workload.title,
                *(summary[key] for key in ("sent", "missing", "answered_twice")),
                summary["invalid"] + summary["strangers"],
                *(quantile(values, share) for share in (0.5, 0.99) for values in (quiet, troubled)),
                max(quiet, default=None),
                max(troubled, default=None),
                outcome.ratio(workload),
                "-" if between is None else f"{between.low:.2f} to {between.high:.2f}",
            )
        )
    columns = ("client", "sent", "lost", "twice", "wrong", "P50 ms", "attacked", "P99 ms", "attacked")
    return Table("honest robots", (*columns, "worst", "attacked", "P99 ratio", "95 %"), tuple(rows))


def _attacks(outcome: Outcome) -> Table:
    rows: list[tuple[str | float | int | None, ...]] = [
        (attack, *counts[:2], f"{counts[2] / 1e6:.1f}", counted_for(attack, outcome.counted))
        for attack, counts in outcome.attacks().items()
    ]
    return Table("attacks", ("attack", "times", "messages", "MB", "counted by the honest"), tuple(rows))


def refusals(outcome: Outcome) -> dict[str, float]:
    """Return everything that the honest programs together counted as refused or dropped during the attack."""
    sums: dict[str, float] = {}
    for series, value in outcome.counted.items():
        short = _short(series)
        if value > 0 and short.startswith(INTERESTING):
            sums[short] = sums.get(short, 0.0) + value
    return dict(sorted(sums.items()))


def _refused(outcome: Outcome) -> Table:
    rows: list[tuple[str | float | int | None, ...]] = [(what, int(times)) for what, times in refusals(outcome).items()]
    return Table("counted while attacked", ("what", "times"), tuple(rows))


def _processes(outcome: Outcome) -> Table:
    begins, ends = (at - outcome.zero_s for at in outcome.attacked)
    rows: list[tuple[str | float | int | None, ...]] = []
    for life in outcome.lives:
        one, other = life.near(begins, 10.0), life.near(ends, 10.0)
        if one is None or other is None:
            continue
        grown = next((each for each in outcome.growths() if each.name == life.name), None)
        share = (other.processor_s - one.processor_s) / outcome.attacked.length_s
        rows.append(
            (
                life.name,
                f"{one.rss_mb:.0f}",
                f"{max(s.rss_mb for s in life.samples):.0f}",
                f"{other.rss_mb:.0f}",
                "-" if grown is None or not grown.judged else f"{grown.rss_mb:+.1f} ± {grown.rss_error_mb:.1f}",
                f"{share:.0%}",
            )
        )
    for name, spent in outcome.insiders_s.items():
        rows.append((f"{name} (insider)", "", "", "", "", f"{spent / outcome.attacked.length_s:.0%}"))
    columns = ("process", "MB before", "most", "MB after", "2nd half", "processor while attacked")
    return Table("processes", columns, tuple(rows))


def show(console: Console, outcome: Outcome) -> None:
    """Show tables and verdicts."""
    for table in tables(outcome):
        console.print(rich_table(table))
    stolen = [load.stolen for load in outcome.loads]
    busy = [load.busy for load in outcome.loads]
    if busy:
        console.print(f"processors: busy {sum(busy) / len(busy):.0%}, stolen {sum(stolen) / len(stolen):.0%}")
    console.print(f"third party: {outcome.third_party_bytes} bytes, at most {outcome.third_party_limit():.0f}")
    verdicts = outcome.verdicts()
    for verdict in verdicts:
        console.print(f"[red]failed: {verdict}[/red]")
    if not verdicts:
        console.print("[green]no honest request lost, none answered twice, P99 within its limit, nothing grows[/green]")


def write_json(path: Path, outcome: Outcome) -> None:
    """Write everything for programs to read."""
    clients = {}
    for workload, records in outcome.records.items():
        quiet, troubled = outcome.quiet(workload), outcome.troubled(workload)
        clients[workload.title] = {
            "summary": records.summary,
            "p50_ms": {"undisturbed": quantile(quiet, 0.5), "attacked": quantile(troubled, 0.5)},
            "p99_ms": {"undisturbed": quantile(quiet, 0.99), "attacked": quantile(troubled, 0.99)},
            "p99_ratio": outcome.ratio(workload),
            "p99_ratio_interval": interval(p99_ratio, troubled, quiet),
        }
    content = {
        "machine": machine(),
        "passed": not outcome.verdicts(),
        "verdicts": outcome.verdicts(),
        "phases_s": {name: getattr(outcome, name).length_s for name in ("before", "attacked", "after")},
        "clients": clients,
        "attacks": {
            name: dict(zip(("times", "messages", "bytes"), c, strict=True)) for name, c in outcome.attacks().items()
        },
        "counted": refusals(outcome),
        "third_party_bytes": outcome.third_party_bytes,
        "insiders_processor_s": outcome.insiders_s,
        "growth": [{**asdict(one), "grows": one.grows} for one in outcome.growths()],
        "lives": [asdict(life) for life in outcome.lives],
        "loads": [asdict(load) for load in outcome.loads],
    }
    path.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
