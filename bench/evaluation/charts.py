"""Draws charts: along a drive, distributions, bars, misses against the deadline and against bytes.

A contender has the same colour in all of them; the direct runs are grey, the ideal is dashed.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.figure import Figure as Canvas
from matplotlib.ticker import FuncFormatter, PercentFormatter

from bench.dataplane.statistics import MS
from bench.evaluation.outcome import UNANSWERED_S
from bench.reporting.tables import text_of
from bench.reporting.web import svg_of

if TYPE_CHECKING:
    from collections.abc import Mapping

    from bench.evaluation.outcome import Figures, Outcome
    from bench.evaluation.redundancy_costs import ModeCost
    from bench.evaluation.studies import Pool

COLOURS = {
    "direct-a": "#555555",
    "direct-b": "#a6a6a6",
    "mptcp": "#8c564b",
    "zenoh": "#9467bd",
    "zenoh-drop": "#c5a3e0",
    "plr-replicate": "#1f5fbf",
    "plr-adaptive": "#e6701a",
    "plr-adaptive-10%": "#f4b183",
    "plr-hedge": "#2c9c3f",
    "plr-hedge-10%": "#98d8a0",
    "plr-single": "#6fb7e0",
    "plr-fallback": "#c8202f",
    "plr-1x1": "#c9a400",
    "plr-1x2": "#17a2b0",
    "plr-2x1": "#e377c2",
    "ideal": "#000000",
}
ALONG = ("direct-a", "direct-b", "plr-replicate", "ideal")
"""Contenders in the chart of one window."""
CURVE_POINTS = 300
BINS = 70
ROOM = 0.85
"""Charts begin at this share of the least latency."""


@dataclass(frozen=True, slots=True)
class Chart:
    """A chart."""

    name: str
    """Name for a file."""
    about: str
    svg: bytes


def along(name: str, scenario: str, runs: Mapping[str, Outcome]) -> Chart:
    """Draw the latency of every request of one window, for the contenders in `ALONG`, which must have run."""
    canvas = Canvas(figsize=(9.5, 4), layout="constrained")
    axes = canvas.add_subplot()
    for contender in ALONG:
        requests = runs[contender].requests
        due_s, latency_ms = zip(*((one.due_s, one.latency_s * MS) for one in requests), strict=True)
        axes.plot(due_s, latency_ms, linewidth=1.1, label=contender, **_line(contender))
    deadline_ms = runs[ALONG[0]].deadline_ms
    axes.axhline(deadline_ms, color="#c8202f", linewidth=0.8, linestyle=":", label="deadline")
    axes.set(title=scenario, xlabel="request due, s", ylabel="latency, ms (10 s: no answer)", yscale="log")
    axes.yaxis.set_major_formatter(_plain())
    axes.grid(alpha=0.25)
    canvas.legend(loc="outside lower center", ncols=len(ALONG) + 1, fontsize=8, frameon=False)
    about = f"Latency of every request along {scenario}, the window in which the direct runs missed most"
    return Chart(name, about, svg_of(canvas))


def distributions(name: str, pool: Pool) -> Chart:
    """Draw histograms of latencies, a row for each contender, with mean and P99."""
    rows = list(pool.runs)
    canvas = Canvas(figsize=(9.5, 0.9 + 0.52 * len(rows)), layout="constrained")
    axes = canvas.add_subplot()
    edges = np.geomspace(_least_ms(pool), UNANSWERED_S * MS * 1.0001, BINS + 1)
    for place, contender in enumerate(reversed(rows)):
        run = pool.together(contender)
        figures = run.figures()
        counts, _ = np.histogram(_latencies_ms(run), edges)
        heights = np.sqrt(counts / len(run.requests))
        colour = _colour(contender)
        axes.stairs(place + 0.85 * heights, edges, baseline=place, fill=True, color=colour, alpha=0.55, linewidth=0)
        axes.plot([figures.p99_ms] * 2, [place, place + 0.8], color=colour, linewidth=2, linestyle="--")
        axes.plot(figures.mean_ms, place + 0.07, "o", color=colour, markersize=5, markeredgecolor="white")
        left = figures.p99_ms > UNANSWERED_S * MS / 2
        offset, side = ((-4, "right"), (4, "left"))[not left]
        axes.annotate(
            f"P99 {_milliseconds(figures.p99_ms)}",
            (figures.p99_ms, place + 0.6),
            textcoords="offset points",
            xytext=(offset, 0),
            ha=side,
            fontsize=8,
        )
    axes.set(
        xscale="log", xlabel="latency, ms (10 s: no answer)", xlim=(edges[0], edges[-1] * 1.1), ylim=(0, len(rows))
    )
    axes.set_yticks(np.arange(len(rows)), reversed(rows), va="bottom")
    axes.xaxis.set_major_formatter(_plain())
    axes.tick_params(axis="y", length=0)
    deadline_ms = pool.runs[rows[0]][0].deadline_ms
    axes.axvline(deadline_ms, color="#c8202f", linewidth=0.8, linestyle=":")
    axes.grid(axis="x", alpha=0.25)
    about = (
        "Distribution of the latencies. The height is the square root of the share of requests. Dashed line: P99. "
        "Dot: mean. Dotted line: deadline"
    )
    return Chart(name, about, svg_of(canvas))


def bars(name: str, figures: Mapping[str, Figures]) -> Chart:
    """Draw misses, mean, P99 and bytes of each contender."""
    panels = {
        "missed, %": [one.miss_ratio * 100 for one in figures.values()],
        "mean, ms": [one.mean_ms for one in figures.values()],
        "P99, ms": [one.p99_ms for one in figures.values()],
        "kB for each request": [(one.bytes_per_request or 0.0) / 1e3 for one in figures.values()],
    }
    canvas = Canvas(figsize=(9.5, 0.8 + 0.27 * len(figures)), layout="constrained")
    all_axes = canvas.subplots(1, len(panels), sharey=True)
    for axes, (title, values) in zip(all_axes, panels.items(), strict=True):
        drawn = axes.barh(list(figures), values, height=0.7)
        for bar, contender in zip(drawn, figures, strict=True):
            bar.set(color=_colour(contender), **({"fill": False, "linestyle": "--"} if contender == "ideal" else {}))
        computed = title == "kB for each request"
        labels = ["computed" if computed and not value else text_of(value) for value in values]
        axes.bar_label(drawn, labels, fontsize=7.5, padding=2)
        axes.set_title(title, fontsize=9)
        axes.margins(x=0.28)
        axes.set_xlim(left=0)
        axes.tick_params(labelsize=8)
        axes.spines[["top", "right"]].set_visible(False)
    all_axes[0].invert_yaxis()
    return Chart(name, "Missed deadlines, mean, P99, and bytes that the robot sent", svg_of(canvas))


def deadlines(name: str, pool: Pool) -> Chart:
    """Draw the share of requests that miss, against the deadline."""
    canvas = Canvas(figsize=(9.5, 4.4), layout="constrained")
    axes = canvas.add_subplot()
    at_ms = np.geomspace(_least_ms(pool), UNANSWERED_S * MS * 0.999, CURVE_POINTS)
    requests = 1
    for contender in pool.runs:
        latencies_ms = np.sort(_latencies_ms(pool.together(contender)))
        requests = len(latencies_ms)
        missed = (requests - np.searchsorted(latencies_ms, at_ms, side="right")) / requests
        shown = missed > 0
        axes.plot(at_ms[shown], missed[shown], label=contender, linewidth=1.4, **_line(contender))
    deadline_ms = next(iter(pool.runs.values()))[0].deadline_ms
    axes.axvline(deadline_ms, color="#c8202f", linewidth=0.8, linestyle=":", label="of the service")
    axes.set(xscale="log", yscale="log", xlabel="deadline, ms", ylabel="missed", ylim=(0.7 / requests, 1.2))
    axes.xaxis.set_major_formatter(_plain())
    axes.yaxis.set_major_formatter(FuncFormatter(lambda share, _place: f"{share * 100:g} %"))
    axes.grid(alpha=0.25)
    canvas.legend(loc="outside right upper", fontsize=8, frameon=False)
    about = "Share of requests that miss, against the deadline. A line ends where no request misses"
    return Chart(name, about, svg_of(canvas))


def modes(name: str, costs: Mapping[str, ModeCost]) -> Chart:
    """Draw what each redundancy mode misses and sends."""
    canvas = Canvas(figsize=(7.5, 4), layout="constrained")
    axes = canvas.add_subplot()
    for mode, cost in costs.items():
        place = (cost.bytes_per_request / 1e3, cost.miss_ratio)
        axes.plot(*place, "o", color=_colour(mode), clip_on=False)
        axes.annotate(mode, place, textcoords="offset points", xytext=(6, 4), fontsize=8)
    axes.set(xlabel="kB sent for each request", ylabel="missed")
    axes.yaxis.set_major_formatter(PercentFormatter(1.0))
    axes.set_ylim(bottom=0)
    axes.margins(x=0.2)
    axes.grid(alpha=0.25)
    windows = next(iter(costs.values())).windows
    about = f"Missed deadlines against bytes sent, over the {windows} windows in which all of these ran"
    return Chart(name, about, svg_of(canvas))


def _latencies_ms(run: Outcome) -> np.ndarray[Any, np.dtype[np.float64]]:
    return np.array([request.latency_s * MS for request in run.requests])


def _least_ms(pool: Pool) -> float:
    runs = (run for of_one in pool.runs.values() for run in of_one)
    return ROOM * max(1.0, min(request.latency_s * MS for run in runs for request in run.requests))


def _colour(contender: str) -> str:
    return COLOURS.get(contender, "#7f7f7f")


def _line(contender: str) -> dict[str, Any]:
    return {"color": _colour(contender), "linestyle": "--" if contender == "ideal" else "-"}


def _plain() -> FuncFormatter:
    return FuncFormatter(lambda value, _place: f"{value:g}")


def _milliseconds(value: float) -> str:
    return f"{value / MS:.3g} s" if value >= MS else f"{value:.3g} ms"
