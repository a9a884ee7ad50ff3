"""All paths dark for ten seconds while the requests go on: the first one sent afterwards must not wait for old ones.

120 kB at 10 Hz over two paths, several outages in each run. What is asked in the dark is answered late or given up;
what counts is the first request sent after the links are back, measured from its submission, though the engine has
yet to see a path up. It is a single request of each outage: its median over the outages counts.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import TYPE_CHECKING

from bench.dataplane.ours import SERVICE, Ours
from bench.dataplane.section import Findings, Plot, Section, table_of
from bench.dataplane.statistics import MS, Calls, Row, median, ratio, worst
from bench.dataplane.topology import CARRIERS, emulated
from bench.netlab import Lab, LinkProfile

if TYPE_CHECKING:
    from collections.abc import Callable

    from bench.dataplane.section import Context

SIZE = 120_000
RATE_HZ = 10.0
BEFORE_S = 8.0
DARK_S = 10.0
QUICK_DARK_S = 4.0
AFTER_S = 4.0
OUTAGES = 3
QUICK_OUTAGES = 1
MARGIN_S = 0.5
"""Who was sent less than this before the links went dark may have been caught by it."""
GRACE_S = 5.0
WARM_UP = 20
LINK = LinkProfile(delay_ms=10, rate_kbps=50_000)
SERVICE_OF_OUTAGE = {**SERVICE, "deadline_ms": 500.0, "lifetime_ms": 10_000.0}


def measure(context: Context) -> Findings:
    """Measure."""
    before: list[Row] = []
    after: list[Row] = []
    repeats: list[list[Recovery]] = []
    line: list[tuple[float, float]] = []
    with (
        Lab(emulated(LINK, LINK)) as lab,
        Ours.in_lab(lab, context.folder, service=SERVICE_OF_OUTAGE) as ours,
    ):
        ours.call(size=SIZE, count=WARM_UP, rate_hz=RATE_HZ)
        for repeat in range(context.repeats):
            context.say(f"outage: {repeat + 1} of {context.repeats}")
            calls, outages = _run(
                ours,
                lab,
                outages=QUICK_OUTAGES if context.quick else OUTAGES,
                dark_s=QUICK_DARK_S if context.quick else DARK_S,
            )
            before.append(calls.between(0, outages[0].dark - MARGIN_S).row("before"))
            after += [outage.after(calls).row("sent after the links are back") for outage in outages]
            repeats.append([Recovery.of(outage.after(calls), calls, outage.back) for outage in outages])
            line = calls.line(outages[-1].back)
    rows = [Row.of_repeats(before), Row.of_repeats(after)]
    lossfree = [row.p99_ms for row in before]
    first = _medians(repeats, lambda recovery: recovery.first_ms)
    after_up = _medians(repeats, lambda recovery: recovery.after_up_ms)
    return Findings(
        figures={
            "outage_path_up_after_ms": median(_medians(repeats, lambda recovery: recovery.up_ms)),
            "outage_first_ms": median(first),
            "outage_first_after_up_ms": median(after_up),
            "outage_first_after_up_worst_ms": worst(
                recovery.after_up_ms for recoveries in repeats for recovery in recoveries
            ),
            "outage_lossfree_p99_ms": median(lossfree),
            "outage_first_over_lossfree_p99": _over(first, lossfree),
            "outage_first_after_up_over_lossfree_p99": _over(after_up, lossfree),
            "outage_lost_after": sum(row.lost for row in after),
        },
        tables=[table_of("120 kB at 10 Hz, both paths dark for a while", rows)],
        plots=[
            Plot("last repeat", "seconds after the links are back", "latency, ms", lines={"ours": line}, log_y=True)
        ],
        notes=[
            "outage_path_up_after_ms: from the links' return to the first answer of any request. outage_first_ms: of"
            " the first request submitted after the links' return; outage_first_after_up_ms: after that answer."
        ],
    )


@dataclass(frozen=True, slots=True)
class Outage:
    """When both links went dark, and came back until when; CLOCK_MONOTONIC."""

    dark: float
    back: float
    until: float

    def after(self, calls: Calls) -> Calls:
        """The requests sent after it, before the next one may catch them."""
        return calls.between(self.back, self.until - MARGIN_S)


@dataclass(frozen=True, slots=True)
class Recovery:
    """What became of one outage's first requests; None when nothing was answered."""

    up_ms: float | None
    """From the links' return to the first answer of any request."""
    first_ms: float | None
    """The first request submitted after the links' return."""
    after_up_ms: float | None
    """The first request submitted after that first answer."""

    @classmethod
    def of(cls, after: Calls, calls: Calls, back: float) -> Recovery:
        """Read it from the run and from its requests sent after the outage."""
        seen = min((at for at in calls.arrivals() if at >= back), default=None)
        if seen is None:
            return cls(None, _first(after), None)
        return cls((seen - back) * MS, _first(after), _first(after.between(seen)))


def _run(ours: Ours, lab: Lab, *, outages: int, dark_s: float) -> tuple[Calls, list[Outage]]:
    """The requests, and the outages."""
    count = round((BEFORE_S + outages * (dark_s + AFTER_S)) * RATE_HZ)
    ours.begin(size=SIZE, count=count, rate_hz=RATE_HZ, grace_s=GRACE_S)
    time.sleep(BEFORE_S)
    found = []
    for _ in range(outages):
        dark = time.monotonic()
        for carrier in CARRIERS:
            lab.link(carrier).blackhole()
        time.sleep(dark_s)
        for carrier in CARRIERS:
            lab.link(carrier).restore()
        back = time.monotonic()
        time.sleep(AFTER_S)
        found.append(Outage(dark, back, time.monotonic()))
    return ours.finish(), found


def _medians(repeats: list[list[Recovery]], of: Callable[[Recovery], float | None]) -> list[float | None]:
    return [median(of(recovery) for recovery in recoveries) for recoveries in repeats]


def _over(values: list[float | None], others: list[float | None]) -> float | None:
    return median(ratio(value, other) for value, other in zip(values, others, strict=True))


def _first(calls: Calls) -> float | None:
    """Latency of the first request, milliseconds; None when it was not answered."""
    latency = calls.latency_s[0] if calls.latency_s else None
    return None if latency is None else latency * MS


SECTION = Section("outage", "All paths dark for ten seconds", measure)
