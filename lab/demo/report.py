"""Reports the demo's figures: table, plot, JSON, one sentence."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

import matplotlib as mpl

mpl.use("Agg")
import matplotlib.pyplot as plt
from rich import box
from rich.table import Table

from examples.request_log import quantile

if TYPE_CHECKING:
    from pathlib import Path

UNANSWERED_MS = 10_000.0
"""Latency of an unanswered request in means and quantiles; if left out, the worse system would look better."""


@dataclass(frozen=True, slots=True)
class Mark:
    """When a phase began, in seconds of the run."""

    name: str
    start_s: float
    shade: str


@dataclass(frozen=True, slots=True)
class Contender:
    """One robot's run."""

    name: str
    sent: int
    lost: int
    answered_twice: int
    wrong: int
    mean_ms: float
    p50_ms: float
    p99_ms: float
    miss_ratio: float
    share_of_wins: float | None
    """Share of the requests that PLR answered over this path; None where that is meaningless."""


def contender(name: str, run: dict[str, Any], share_of_wins: float | None) -> Contender:
    """Sum up the JSON that the example client wrote."""
    deadline_ms = run["deadline_ms"]
    requests = run["requests"]
    latencies = sorted(UNANSWERED_MS if r["latency_ms"] is None else r["latency_ms"] for r in requests)
    return Contender(
        name,
        sent=len(requests),
        lost=sum(r["answers"] == 0 for r in requests),
        answered_twice=sum(r["answers"] > 1 for r in requests),
        wrong=run["summary"]["invalid"] + run["summary"]["strangers"],
        mean_ms=sum(latencies) / len(latencies),
        p50_ms=quantile(latencies, 0.5) or 0.0,
        p99_ms=quantile(latencies, 0.99) or 0.0,
        miss_ratio=sum(latency > deadline_ms for latency in latencies) / len(latencies),
        share_of_wins=share_of_wins,
    )


def table(contenders: list[Contender], deadline_ms: float) -> Table:
    """Return the figures as a table."""
    title = f"Robot asking for a path at 10 Hz, deadline {deadline_ms:g} ms; latencies in ms"
    shown = Table(box=box.SIMPLE, pad_edge=False, title=title)
    shown.add_column("", no_wrap=True)
    for column in ("sent", "lost", "twice", "mean", "P50", "P99", "missed", "PLR wins"):
        shown.add_column(column, justify="right", no_wrap=True)
    for row in contenders:
        shown.add_row(
            row.name,
            str(row.sent),
            str(row.lost),
            str(row.answered_twice),
            f"{row.mean_ms:.0f}",
            f"{row.p50_ms:.0f}",
            f"{row.p99_ms:.0f}",
            f"{row.miss_ratio:.2%}",
            "" if row.share_of_wins is None else f"{row.share_of_wins:.0%}",
        )
    return shown


def sentence(contenders: list[Contender], deadline_ms: float) -> str:
    """Return what was observed, good or bad, in one sentence."""
    plr, *singles = contenders[::-1]
    missed = ", ".join(f"{single.name} {single.miss_ratio:.1%}" for single in singles[::-1])
    return (
        f"PLR answered {plr.sent - plr.lost} of {plr.sent} requests ({plr.answered_twice} twice) and missed the "
        f"{deadline_ms:g} ms deadline for {plr.miss_ratio:.1%} of them, P99 {plr.p99_ms:.0f} ms, while each carrier "
        f"was dark, a server and the control plane were killed; missed over one carrier: {missed}."
    )


def write_json(
    path: Path, contenders: list[Contender], marks: list[Mark], lateness_ms: dict[str, float], said: str
) -> None:
    """Write everything in the table and the sentence, and how late the link emulator's timers ran."""
    content = {
        "contenders": [asdict(contender) for contender in contenders],
        "phases": [asdict(mark) for mark in marks],
        "emulator_lateness_p99_ms": lateness_ms,
        "sentence": said,
    }
    path.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


def plot(path: Path, runs: dict[str, dict[str, Any]], marks: list[Mark], zero_s: float, deadline_ms: float) -> None:
    """Plot the latency of every request along the run, one panel for each robot."""
    figure, panels = plt.subplots(len(runs), 1, sharex=True, sharey=True, figsize=(11, 2.3 * len(runs)))
    for panel, (name, run) in zip(panels, runs.items(), strict=True):
        sent = [r["sent_s"] - zero_s for r in run["requests"]]
        latency = [UNANSWERED_MS if r["latency_ms"] is None else r["latency_ms"] for r in run["requests"]]
        late = [value > deadline_ms for value in latency]
        colours = ["#c0392b" if is_late else "#1f618d" for is_late in late]
        panel.scatter(sent, latency, s=5, c=colours, zorder=3)
        panel.axhline(deadline_ms, color="#c0392b", linewidth=0.8, linestyle="--")
        panel.set_yscale("log")
        panel.set_ylabel("ms")
        panel.set_title(f"{name}: {sum(late)} of {len(late)} late", loc="left", fontsize=10)
        ends = [mark.start_s for mark in marks[1:]] + [max(sent)]
        for mark, end in zip(marks, ends, strict=True):
            panel.axvspan(mark.start_s, end, color=mark.shade, linewidth=0, zorder=0)
    for mark in marks:
        panels[0].annotate(
            mark.name,
            (mark.start_s, 1.18),
            xycoords=("data", "axes fraction"),
            fontsize=8,
            rotation=12,
        )
    panels[-1].set_xlabel("seconds")
    figure.tight_layout()
    figure.savefig(path, dpi=110)
    plt.close(figure)
