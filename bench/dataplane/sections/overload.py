"""Overloads a path with five times its rate beside a good one, which must not suffer.

120 kB at 10 Hz are 9.6 Mbit/s. Undisturbed, they take only the good path; overloaded, a copy of each also goes over the
path of 2 Mbit/s. The two take turns.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from bench.dataplane.ours import EVERY_CARRIER, Ours
from bench.dataplane.section import Findings, Plot, Section, table_of
from bench.dataplane.statistics import Row, interval, median, p99_ratio, ratio, worst
from bench.dataplane.topology import CARRIERS, emulated
from lab import Lab, LinkProfile

if TYPE_CHECKING:
    from bench.dataplane.section import Context
    from bench.dataplane.statistics import Calls

SIZE = 120_000
RATE_HZ = 10.0
COUNT = 200
"""Requests of a repeat: six in three repeats are beyond the P99."""
WARM_UP = 20
GOOD = LinkProfile(delay_ms=10, rate_kbps=50_000)
SLOW = LinkProfile(delay_ms=10, rate_kbps=2_000)
MB = 1e6


def measure(context: Context) -> Findings:
    """Measure."""
    rows: dict[str, list[Row]] = {"undisturbed": [], "overloaded": []}
    last: dict[str, Calls] = {}
    pooled: dict[str, list[float]] = {"undisturbed": [], "overloaded": []}
    growth: list[float] = []
    mappings = {"undisturbed": EVERY_CARRIER[:1], "overloaded": EVERY_CARRIER}
    with (
        Lab(emulated(GOOD, SLOW)) as lab,
        Ours.in_lab(lab, context.folder, mapping=mappings["undisturbed"], interfaces=CARRIERS) as ours,
    ):
        ours.call(size=SIZE, count=WARM_UP, rate_hz=RATE_HZ)
        for repeat in range(context.repeats):
            for name, mapping in mappings.items():
                context.say(f"overload: {name}, {repeat + 1} of {context.repeats}")
                ours.map_to(mapping)
                ours.call(size=SIZE, count=WARM_UP // 2, rate_hz=RATE_HZ)
                before = float(ours.robot.ask("usage")["peak_bytes"])
                last[name] = ours.call(size=SIZE, count=context.scaled(COUNT, 20), rate_hz=RATE_HZ)
                rows[name].append(last[name].row(f"good path, {name}"))
                pooled[name] += last[name].answered_ms()
                if name == "overloaded":
                    growth.append((float(ours.robot.ask("usage")["peak_bytes"]) - before) / MB)
        dropped = ours.robot.ask("counters")["dropped"]
    lines = {name: calls.line(calls.sent_s[0]) for name, calls in last.items()}
    undisturbed, overloaded = rows["undisturbed"], rows["overloaded"]
    return Findings(
        figures={
            "undisturbed_p99_ms": median(row.p99_ms for row in undisturbed),
            "overload_p99_ms": median(row.p99_ms for row in overloaded),
            "overload_p99_over_undisturbed": p99_ratio(pooled["overloaded"], pooled["undisturbed"]),
            "overload_p99_over_undisturbed_of_repeats": median(
                ratio(one.p99_ms, other.p99_ms) for one, other in zip(overloaded, undisturbed, strict=True)
            ),
            "overload_lost": sum(row.lost for row in overloaded),
            "overload_memory_growth_mb": worst(growth),
        },
        intervals={"overload_p99_over_undisturbed": interval(p99_ratio, pooled["overloaded"], pooled["undisturbed"])},
        tables=[
            table_of(
                "120 kB at 10 Hz; overloaded: also over a path of 2 Mbit/s",
                [Row.of_repeats(undisturbed), Row.of_repeats(overloaded)],
            )
        ],
        plots=[Plot("last repeat", "seconds", "latency, ms", lines=lines)],
        notes=[f"What the robot's engine dropped meanwhile: {dropped or 'nothing'}."],
    )


SECTION = Section("overload", "A path too slow for what it is asked", measure)
