"""Darkens all paths while requests go on: the first one sent afterwards must not wait for old ones.

120 kB at 10 Hz go over two paths, with several outages of 2 to 10 s in each run. Requests sent in the dark are answered
late or given up. What counts is the first request sent once a path is seen to be up again, measured from its
submission. That is a single request of each outage, so many outages are needed: their median counts, over the P99 of
all requests before the outages. The links come back at random times between two requests, since the first request
depends on that time: a run whose outages all ended at the same one would show that case alone.
"""

from __future__ import annotations

import random
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING

from bench.dataplane.ours import SERVICE, Ours
from bench.dataplane.section import Findings, Plot, Section, table_of
from bench.dataplane.statistics import MS, Calls, Row, interval, median, quantile, ratio, worst
from bench.dataplane.topology import CARRIERS, emulated
from bench.reporting.tables import Table
from lab import Lab, LinkProfile

if TYPE_CHECKING:
    from collections.abc import Sequence

    from bench.dataplane.section import Context
    from bench.dataplane.statistics import Interval

SIZE = 120_000
RATE_HZ = 10.0
BEFORE_S = 15.0
LONG_S = 10.0
DARK_S = (LONG_S, 2.0, LONG_S, 6.0, 3.0, LONG_S, 4.0)
"""Outages of each run, each lengthened at random by up to one request's interval. Three are long, as the figure was
first defined."""
QUICK_DARK_S = (4.0, 2.0)
AFTER_S = 2.5
MARGIN_S = 0.5
"""A request sent less than this before the links went dark may have been caught by the outage."""
GRACE_S = 5.0
WARM_UP = 20
LINK = LinkProfile(delay_ms=10, rate_kbps=50_000)
SERVICE_OF_OUTAGE = {**SERVICE, "deadline_ms": 500.0, "lifetime_ms": 10_000.0}


def measure(context: Context) -> Findings:
    """Measure."""
    runs: list[Run] = []
    with (
        Lab(emulated(LINK, LINK)) as lab,
        Ours.in_lab(lab, context.folder, service=SERVICE_OF_OUTAGE) as ours,
    ):
        ours.call(size=SIZE, count=WARM_UP, rate_hz=RATE_HZ)
        for repeat in range(context.repeats):
            context.say(f"outage: {repeat + 1} of {context.repeats}")
            lengths = QUICK_DARK_S if context.quick else DARK_S
            runs.append(_run(ours, lab, lengths, random.Random(repeat)))
    return Findings(
        figures={**_figures(runs), **_figures_of_repeats(runs)},
        intervals=_intervals(runs),
        tables=[_table(runs), _recoveries(runs)],
        plots=[
            Plot(
                "last outage",
                "seconds after the links are back",
                "latency, ms",
                lines={"ours": runs[-1].calls.line(runs[-1].outages[-1].back)},
                log_y=True,
            )
        ],
        notes=[
            "outage_path_up_after_ms: from the links' return to the first answer of any request. outage_first_ms: of"
            " the first request submitted after the links' return; outage_first_after_up_ms: after that answer."
        ],
    )


@dataclass(frozen=True, slots=True)
class Outage:
    """When both links went dark and came back, and until when they stayed up; CLOCK_MONOTONIC."""

    dark: float
    back: float
    until: float

    def after(self, calls: Calls) -> Calls:
        """Return the requests sent after the outage, before the next one may catch them."""
        return calls.between(self.back, self.until - MARGIN_S)


@dataclass(frozen=True, slots=True)
class Recovery:
    """What became of the first requests after an outage; None if nothing was answered."""

    up_ms: float | None
    """Time from the links' return to the first answer to any request."""
    first_ms: float | None
    """Latency of the first request submitted after the links' return."""
    after_up_ms: float | None
    """Latency of the first request submitted after that first answer."""

    @classmethod
    def of(cls, after: Calls, calls: Calls, back: float) -> Recovery:
        """Derive it from the run and its requests sent after the outage."""
        seen = min((at for at in calls.arrivals() if at >= back), default=None)
        if seen is None:
            return cls(None, _first(after), None)
        return cls((seen - back) * MS, _first(after), _first(after.between(seen)))


@dataclass(frozen=True, slots=True)
class Run:
    """One repeat."""

    calls: Calls
    outages: list[Outage]

    def before(self) -> Calls:
        """Return the requests before the first outage."""
        return self.calls.between(0, self.outages[0].dark - MARGIN_S)

    def recoveries(self) -> list[Recovery]:
        """Return the recovery from each outage."""
        return [Recovery.of(outage.after(self.calls), self.calls, outage.back) for outage in self.outages]


def _run(ours: Ours, lab: Lab, lengths: Sequence[float], rng: random.Random) -> Run:
    lengths = [length + rng.uniform(0.0, 1 / RATE_HZ) for length in lengths]
    count = round((BEFORE_S + sum(lengths) + len(lengths) * AFTER_S) * RATE_HZ)
    ours.begin(size=SIZE, count=count, rate_hz=RATE_HZ, grace_s=GRACE_S)
    time.sleep(BEFORE_S)
    found = []
    for length in lengths:
        dark = time.monotonic()
        for carrier in CARRIERS:
            lab.link(carrier).blackhole()
        time.sleep(length)
        for carrier in CARRIERS:
            lab.link(carrier).restore()
        back = time.monotonic()
        time.sleep(AFTER_S)
        found.append(Outage(dark, back, time.monotonic()))
    return Run(ours.finish(), found)


# -- figures ------------------------------------------------------------------------------------------------------


def _after_up(runs: Sequence[Run]) -> list[float]:
    firsts = (recovery.after_up_ms for run in runs for recovery in run.recoveries())
    return [first for first in firsts if first is not None]


def _before(runs: Sequence[Run]) -> list[float]:
    return [latency for run in runs for latency in run.before().answered_ms()]


def _median_over_p99(firsts: Sequence[float], before: Sequence[float]) -> float | None:
    return ratio(median(firsts), quantile(before, 0.99))


def _p90_over_p99(firsts: Sequence[float], before: Sequence[float]) -> float | None:
    return ratio(quantile(firsts, 0.9), quantile(before, 0.99))


def _figures(runs: Sequence[Run]) -> dict[str, float | None]:
    recoveries = [recovery for run in runs for recovery in run.recoveries()]
    firsts, before = _after_up(runs), _before(runs)
    first = median(recovery.first_ms for recovery in recoveries)
    return {
        "outage_path_up_after_ms": median(recovery.up_ms for recovery in recoveries),
        "outage_first_ms": first,
        "outage_first_after_up_ms": median(firsts),
        "outage_first_after_up_p90_ms": quantile(firsts, 0.9),
        "outage_first_after_up_worst_ms": worst(firsts),
        "outage_lossfree_p99_ms": quantile(before, 0.99),
        "outage_first_over_lossfree_p99": ratio(first, quantile(before, 0.99)),
        "outage_first_after_up_over_lossfree_p99": _median_over_p99(firsts, before),
        "outage_first_after_up_p90_over_lossfree_p99": _p90_over_p99(firsts, before),
        "outage_first_unanswered": len(recoveries) - len(firsts),
        "outage_lost_after": sum(outage.after(run.calls).row("").lost for run in runs for outage in run.outages),
    }


def _intervals(runs: Sequence[Run]) -> dict[str, Interval | None]:
    firsts, before = _after_up(runs), _before(runs)
    return {
        "outage_first_after_up_over_lossfree_p99": interval(_median_over_p99, firsts, before, block=1),
        "outage_first_after_up_p90_over_lossfree_p99": interval(_p90_over_p99, firsts, before, block=1),
    }


def _figures_of_repeats(runs: Sequence[Run]) -> dict[str, float | None]:
    """Return the figure as first defined: each repeat's median over its outages of 10 s, over its own P99."""
    ratios = []
    for run in runs:
        long = [
            recovery.after_up_ms
            for outage, recovery in zip(run.outages, run.recoveries(), strict=True)
            if outage.back - outage.dark >= LONG_S
        ]
        ratios.append(ratio(median(long), run.before().row("").p99_ms))
    return {"outage_first_after_up_over_lossfree_p99_of_repeats": median(ratios)}


def _table(runs: Sequence[Run]) -> Table:
    before = Row.of_repeats([run.before().row("before") for run in runs])
    after = [outage.after(run.calls).row("sent after the links are back") for run in runs for outage in run.outages]
    return table_of("120 kB at 10 Hz, both paths dark for a while", [before, Row.of_repeats(after)])


def _recoveries(runs: Sequence[Run]) -> Table:
    seen = [each for run in runs for each in zip(run.outages, run.recoveries(), strict=True)]
    seen.sort(key=lambda each: each[0].back - each[0].dark)
    rows = tuple(
        (f"{outage.back - outage.dark:.2f} s", recovery.up_ms, recovery.first_ms, recovery.after_up_ms)
        for outage, recovery in seen
    )
    columns = ("dark for", "path up after ms", "first request ms", "first once a path is up ms")
    return Table("each outage", columns, rows)


def _first(calls: Calls) -> float | None:
    """Return the latency of the first request in milliseconds; None if it was not answered."""
    latency = calls.latency_s[0] if calls.latency_s else None
    return None if latency is None else latency * MS


SECTION = Section("outage", "All paths dark for a while", measure)
