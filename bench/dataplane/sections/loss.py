"""Measures large requests over a long link that loses packets: retransmission alone, with FEC, and without loss.

150 kB at 10 Hz go over one path of 50 ms round trip and 100 Mbit/s; every packet, in either direction, is lost with the
same probability. Both variants are alive at once and take turns; each sends some requests before it is measured, so
that it knows the path.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from bench.dataplane.ours import EVERY_CARRIER, SERVICE, Ours
from bench.dataplane.section import Findings, Plot, Section
from bench.dataplane.statistics import Calls, Row, difference, interval, median, p99, p99_ratio, quantile, ratio
from bench.dataplane.targets import RTT_MS
from bench.dataplane.topology import CARRIERS, emulated
from bench.reporting.tables import Table
from lab import Lab, LinkProfile

if TYPE_CHECKING:
    from collections.abc import Sequence

    from bench.dataplane.section import Context
    from bench.reporting.tables import Figure

SIZE = 150_000
RATE_HZ = 10.0
WARM_UP = 20
COUNT = 170
"""Requests without loss and at losses with targets: five in three repeats are beyond the P99. A third elsewhere."""
LOSSES = (0.0, 0.02, 0.01, 0.05)
JUDGED = (0.0, 0.02)
LINK = LinkProfile(delay_ms=RTT_MS / 2, rate_kbps=100_000)
MODES = {"arq": "off", "fec": "auto"}
NAMES = {"arq": "ARQ alone", "fec": "FEC auto"}

Key = tuple[str, float]


def measure(context: Context) -> Findings:
    """Measure."""
    runs: dict[Key, list[Calls]] = {}
    overheads: dict[Key, list[float]] = {}
    with Lab(emulated(LINK)) as lab, _start(context, lab, "arq") as arq, _start(context, lab, "fec") as fec:
        for repeat in range(context.repeats):
            for loss in LOSSES:
                lab.link(CARRIERS[0]).change(loss=loss)
                for mode, ours in (("arq", arq), ("fec", fec)):
                    if loss not in JUDGED and repeat:
                        continue
                    context.say(f"loss: {NAMES[mode]}, {loss:.0%} lost, {repeat + 1} of {context.repeats}")
                    count = context.scaled(COUNT if loss in JUDGED else COUNT // 3, 20)
                    calls, overhead = _run(ours, count)
                    runs.setdefault((mode, loss), []).append(calls)
                    overheads.setdefault((mode, loss), []).append(overhead)
        lateness = lab.link(CARRIERS[0]).stats().lateness
    rows = {key: [calls.row(f"{NAMES[key[0]]}, {key[1]:.0%} lost") for calls in found] for key, found in runs.items()}
    pooled = {key: [value for calls in found for value in calls.answered_ms()] for key, found in runs.items()}
    lossfree, by_arq, by_fec = pooled["arq", 0.0], pooled["arq", 0.02], pooled["fec", 0.02]
    return Findings(
        figures={
            **_figures(rows, overheads),
            "fec_p99_over_lossfree_2pct": p99_ratio(by_fec, lossfree),
            "arq_p99_minus_lossfree_ms_2pct": p99_difference(by_arq, lossfree),
        },
        intervals={
            "fec_p99_over_lossfree_2pct": interval(p99_ratio, by_fec, lossfree),
            "arq_p99_minus_lossfree_ms_2pct": interval(p99_difference, by_arq, lossfree),
        },
        tables=[_table(rows, overheads)],
        plots=[_plot(rows)],
        notes=[
            f"The emulator let packets go {lateness.p99_s * 1e3:.2f} ms late in 99 % of cases or less.",
            "Compared with retransmission alone without loss, the requests of all repeats together; ..._of_repeats: in"
            " each repeat, and the median of those counts.",
        ],
    )


def _start(context: Context, lab: Lab, mode: str) -> Ours:
    service = {**SERVICE, "fec": MODES[mode]}
    return Ours.in_lab(lab, context.folder, mapping=EVERY_CARRIER[:1], service=service, name=f"ours-{mode}")


def p99_difference(samples: Sequence[float], others: Sequence[float]) -> float | None:
    """Return by how much the P99 of the samples exceeds that of the others."""
    return difference(p99(samples), p99(others))


def _run(ours: Ours, count: int) -> tuple[Calls, float]:
    """Return a run, and the bytes sent for each byte of its requests."""
    ours.call(size=SIZE, count=WARM_UP, rate_hz=RATE_HZ)
    before = ours.sent_bytes()
    calls = ours.call(size=SIZE, count=count, rate_hz=RATE_HZ)
    return calls, (ours.sent_bytes() - before) / (count * SIZE)


def _figures(rows: dict[Key, list[Row]], overheads: dict[Key, list[float]]) -> dict[str, Figure]:
    lossfree = [row.p99_ms for row in rows["arq", 0.0]]
    figures: dict[str, Figure] = {
        "lossfree_p99_ms": median(lossfree),
        "fec_p99_over_lossfree_2pct_of_repeats": median(
            ratio(row.p99_ms, free) for row, free in zip(rows["fec", 0.02], lossfree, strict=True)
        ),
        "arq_p99_minus_lossfree_ms_2pct_of_repeats": median(
            difference(row.p99_ms, free) for row, free in zip(rows["arq", 0.02], lossfree, strict=True)
        ),
        "loss_lost": sum(row.lost for repeats in rows.values() for row in repeats),
    }
    for (mode, loss), repeats in rows.items():
        figures[f"{mode}_p99_ms_{loss * 100:.0f}pct"] = median(row.p99_ms for row in repeats)
        figures[f"{mode}_sent_over_payload_{loss * 100:.0f}pct"] = median(overheads[mode, loss])
    return figures


def _table(rows: dict[Key, list[Row]], overheads: dict[Key, list[float]]) -> Table:
    columns = ("", "requests", "lost", "P50 ms", "P99 ms", "worst ms", "bytes sent / payload")
    shown = []
    for key in sorted(rows):
        row = Row.of_repeats(rows[key])
        overhead = quantile(overheads[key], 0.5)
        shown.append((row.name, row.sent, row.lost, row.p50_ms, row.p99_ms, row.max_ms, overhead))
    return Table("150 kB at 10 Hz over 50 ms round trip", columns, tuple(shown))


def _plot(rows: dict[Key, list[Row]]) -> Plot:
    lines = {
        NAMES[mode]: [(loss * 100, median(row.p99_ms for row in rows[mode, loss]) or 0.0) for loss in sorted(LOSSES)]
        for mode in MODES
    }
    return Plot("P99 of 150 kB over 50 ms round trip", "packets lost, %", "ms", lines=lines)


SECTION = Section("loss", "A far link that loses packets", measure)
