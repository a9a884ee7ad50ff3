"""Lets a stranger flood the port of a sidecar with junk during requests: none may be lost, or be late by much.

The junk is noise, and what a listener on the path can make of real datagrams. It leaves and arrives one by one: a run
that the kernel joins would be cheaper for us than a stranger's flood.
"""

from __future__ import annotations

import base64
import time
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from bench.dataplane.ours import Ours
from bench.dataplane.remote import Remote
from bench.dataplane.section import Findings, Plot, Section, table_of
from bench.dataplane.statistics import Row, interval, median, p99, ratio, worst
from bench.dataplane.topology import CARRIERS, CLOUD, CLOUD_INTERFACE, CLOUDS, ROBOT, cables
from bench.reporting.tables import Table
from lab import Lab
from lab.attacker.junk import JunkKind
from lab.attacker.wire import Tap

if TYPE_CHECKING:
    from collections.abc import Sequence

    from bench.dataplane.section import Context
    from bench.dataplane.statistics import Calls
    from lab.attacker.wire import Captured

JUNK_HZ = 20_000.0
SIZE = 1_000
RATE_HZ = 50.0
COUNT = 300
WARM_UP = 50
SETTLE_S = 0.3
ALLOWED_MS = 5.0
"""How much the P99 may rise; it may also double."""
KINDS = tuple(kind for kind in JunkKind if kind is not JunkKind.MANGLED)
ATTACKER = CLOUDS[1]
QUIET = "undisturbed"


@dataclass(slots=True)
class Flood:
    """A lab with its victims, and the datagrams captured there."""

    context: Context
    ours: Ours
    attacker: Remote
    addresses: dict[str, str]
    seen: list[Captured]
    """Captured datagrams from the start on, including the introductions."""
    rows: dict[str, list[Row]] = field(default_factory=dict)
    pooled: dict[str, list[float]] = field(default_factory=dict)
    """Latencies of all repeats by name, ms."""
    arrived: dict[str, list[float]] = field(default_factory=dict)
    cost_us: dict[str, list[float]] = field(default_factory=dict)
    last: dict[str, Calls] = field(default_factory=dict)
    _quiet_cpu_s: dict[str, float] = field(default_factory=dict)

    def quiet(self) -> None:
        """Call without a flood."""
        before = {name: self._cpu_s(name) for name in self.addresses}
        self._call(QUIET)
        self._quiet_cpu_s = {name: self._cpu_s(name) - before[name] for name in self.addresses}

    def flooded(self, victim: str, kind: JunkKind) -> None:
        """Call while a victim is flooded."""
        name = f"{kind} at the {victim}"
        program = self._program(victim)
        refused, cpu_s = self._refused(program), self._cpu_s(victim)
        address, port = next(one.destination for one in self.seen if one.destination[0] == self.addresses[victim])
        mine = [base64.b64encode(one.payload).decode() for one in self.seen if one.destination == (address, port)]
        seconds = self.context.scaled(COUNT) / RATE_HZ + 2 * SETTLE_S
        plan = {"kind": kind, "seen": mine, "rate_hz": JUNK_HZ, "seconds": seconds}
        self.attacker.begin("flood", address=address, port=port, **plan)
        time.sleep(SETTLE_S)
        self._call(name)
        sent = self.attacker.finish()["sent"]
        time.sleep(SETTLE_S)
        self.arrived.setdefault(name, []).append((self._refused(program) - refused) / sent)
        spent = self._cpu_s(victim) - cpu_s - self._quiet_cpu_s[victim]
        self.cost_us.setdefault(name, []).append(spent / sent * 1e6)

    def _call(self, name: str) -> None:
        self.context.say(f"flood: {name}")
        calls = self.last[name] = self.ours.call(size=SIZE, count=self.context.scaled(COUNT), rate_hz=RATE_HZ)
        self.rows.setdefault(name, []).append(calls.row(name))
        self.pooled.setdefault(name, []).extend(calls.answered_ms())

    def _program(self, victim: str) -> Remote:
        return self.ours.robot if victim == ROBOT else self.ours.clouds[victim]

    def _cpu_s(self, victim: str) -> float:
        return float(self._program(victim).ask("usage")["cpu_s"])

    @staticmethod
    def _refused(program: Remote) -> int:
        """Return the datagrams that a program counted as dropped, for any reason."""
        return sum(sum(link["dropped"].values()) for link in program.ask("counters")["links"].values())


def measure(context: Context) -> Findings:
    """Measure."""
    with (
        Lab(cables()) as lab,
        Tap(lab.host(CLOUD), CLOUD_INTERFACE) as tap,
        Ours.in_lab(lab, context.folder, mapping=None) as ours,
        Remote.start("flood", context.folder, host=lab.host(ATTACKER)) as attacker,
    ):
        ours.call(size=SIZE, count=WARM_UP, rate_hz=RATE_HZ)
        addresses = {CLOUD: lab.host(CLOUD).address(), ROBOT: lab.host(ROBOT).address(CARRIERS[0])}
        flood = Flood(context, ours, attacker, addresses, tap.take())
        for _ in range(context.repeats):
            flood.quiet()
            for victim in addresses:
                for kind in KINDS:
                    flood.flooded(victim, kind)
    return _findings(flood)


def _p99_over_allowed(flooded: Sequence[float], quiet: Sequence[float]) -> float | None:
    undisturbed = p99(quiet) or 0.0
    return ratio(p99(flooded), max(ALLOWED_MS + undisturbed, 2 * undisturbed))


def _findings(flood: Flood) -> Findings:
    rows = {name: Row.of_repeats(found) for name, found in flood.rows.items()}
    undisturbed = rows.pop(QUIET)
    allowed = max(ALLOWED_MS + (undisturbed.p99_ms or 0.0), 2 * (undisturbed.p99_ms or 0.0))
    kinds = list(rows)
    slowest = max(kinds, key=lambda name: p99(flood.pooled[name]) or 0.0)
    cost = {name: median(flood.cost_us[name]) for name in kinds}
    return Findings(
        figures={
            "flood_lost": sum(row.lost for row in rows.values()),
            "flood_undisturbed_p99_ms": undisturbed.p99_ms,
            "flood_worst_p99_ms": worst(row.p99_ms for row in rows.values()),
            "flood_p99_over_allowed": _p99_over_allowed(flood.pooled[slowest], flood.pooled[QUIET]),
            "flood_p99_over_allowed_of_repeats": worst(ratio(row.p99_ms, allowed) for row in rows.values()),
            "flood_us_per_junk_datagram": worst(cost.values()),
            "flood_least_arrived": min(min(values) for values in flood.arrived.values()),
        },
        intervals={"flood_p99_over_allowed": interval(_p99_over_allowed, flood.pooled[slowest], flood.pooled[QUIET])},
        tables=[
            table_of(
                f"1 kB at {RATE_HZ:g} Hz, and {JUNK_HZ:g} datagrams of junk a second", [undisturbed, *rows.values()]
            ),
            Table(
                "what junk costs",
                ("", "processor us each", "refused of those sent"),
                tuple((name, cost[name], median(flood.arrived[name])) for name in kinds),
            ),
        ],
        plots=[
            Plot(
                "last repeat",
                "seconds",
                "latency, ms",
                lines={name: calls.line(calls.sent_s[0]) for name, calls in flood.last.items()},
            )
        ],
    )


SECTION = Section("flood", "Junk at a sidecar's port", measure)
