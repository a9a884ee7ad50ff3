"""All paths dark for ten seconds while the requests go on: the first one sent afterwards must not wait for old ones.

120 kB at 10 Hz over two paths. What is asked in the dark is answered late or given up; what counts is the first
request sent after the links are back, measured from its submission, though the engine has yet to see a path up.
"""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

from bench.dataplane.ours import SERVICE, Ours
from bench.dataplane.section import Findings, Plot, Section, Table
from bench.dataplane.statistics import MS, Calls, Row, median, ratio
from bench.dataplane.topology import CARRIERS, CLOUD, CLOUD_INTERFACE, ROBOT, emulated
from bench.netlab import Lab, LinkProfile

if TYPE_CHECKING:
    from bench.dataplane.section import Context

SIZE = 120_000
RATE_HZ = 10.0
BEFORE_S = 4.0
DARK_S = 10.0
QUICK_DARK_S = 4.0
AFTER_S = 4.0
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
    first_ms: list[float | None] = []
    seen_ms: list[float | None] = []
    first_seen_ms: list[float | None] = []
    line: list[tuple[float, float]] = []
    with (
        Lab(emulated(LINK, LINK)) as lab,
        Ours(
            context.folder,
            robot=lab.host(ROBOT),
            clouds={CLOUD: lab.host(CLOUD)},
            interfaces=CARRIERS,
            cloud_interface=CLOUD_INTERFACE,
            mapping=[(carrier, CLOUD) for carrier in CARRIERS],
            service=SERVICE_OF_OUTAGE,
        ) as ours,
    ):
        ours.call(size=SIZE, count=WARM_UP, rate_hz=RATE_HZ)
        for repeat in range(context.repeats):
            context.say(f"outage: {repeat + 1} of {context.repeats}")
            calls, dark, back = _run(ours, lab, QUICK_DARK_S if context.quick else DARK_S)
            before.append(calls.between(0, dark - MARGIN_S).row("before"))
            after.append(calls.between(back).row("sent after the links are back"))
            seen = min((at for at in calls.arrivals() if at >= back), default=None)
            seen_ms.append(None if seen is None else (seen - back) * MS)
            first_ms.append(_first(calls.between(back)))
            first_seen_ms.append(None if seen is None else _first(calls.between(seen)))
            line = calls.line(back)
    rows = [Row.of_repeats(before), Row.of_repeats(after)]
    lossfree = [row.p99_ms for row in before]
    return Findings(
        figures={
            "outage_path_up_after_ms": median(seen_ms),
            "outage_first_ms": median(first_ms),
            "outage_first_after_up_ms": median(first_seen_ms),
            "outage_lossfree_p99_ms": median(lossfree),
            "outage_first_over_lossfree_p99": _over(first_ms, lossfree),
            "outage_first_after_up_over_lossfree_p99": _over(first_seen_ms, lossfree),
            "outage_lost_after": sum(row.lost for row in after),
        },
        tables=[Table.of_rows("120 kB at 10 Hz, both paths dark for a while", rows)],
        plots=[
            Plot("last repeat", "seconds after the links are back", "latency, ms", lines={"ours": line}, log_y=True)
        ],
        notes=[
            "outage_path_up_after_ms: from the links' return to the first answer of any request. outage_first_ms: of"
            " the first request submitted after the links' return; outage_first_after_up_ms: after that answer."
        ],
    )


def _run(ours: Ours, lab: Lab, dark_s: float) -> tuple[Calls, float, float]:
    """The requests, and the moments at which both links went dark and came back."""
    count = round((BEFORE_S + dark_s + AFTER_S) * RATE_HZ)
    ours.begin(size=SIZE, count=count, rate_hz=RATE_HZ, grace_s=GRACE_S)
    time.sleep(BEFORE_S)
    dark = time.monotonic()
    for carrier in CARRIERS:
        lab.link(carrier).blackhole()
    time.sleep(dark_s)
    for carrier in CARRIERS:
        lab.link(carrier).restore()
    back = time.monotonic()
    return ours.finish(), dark, back


def _over(values: list[float | None], others: list[float | None]) -> float | None:
    return median(ratio(value, other) for value, other in zip(values, others, strict=True))


def _first(calls: Calls) -> float | None:
    """Latency of the first request, milliseconds; None when it was not answered."""
    latency = calls.latency_s[0] if calls.latency_s else None
    return None if latency is None else latency * MS


SECTION = Section("outage", "All paths dark for ten seconds", measure)
