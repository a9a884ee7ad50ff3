"""Computes the figures of `targets` from the records of runs, each with its basis. Void runs count nowhere."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from bench.dataplane.statistics import MS, median
from bench.evaluation import counters, repeats
from bench.evaluation.comparison import DIRECT, IDEAL, ONE_RADIO, SUREST, gains, one_radio_gain, over_direct
from bench.evaluation.measured import Measured
from bench.evaluation.outcome import Outcome, by_window, figures_by_window
from bench.evaluation.redundancy_costs import mode_costs
from bench.evaluation.studies import is_recorded
from plr.protos.model.explanation import Correlation

if TYPE_CHECKING:
    from collections.abc import Sequence

    from bench.evaluation.outcome import Windows
    from bench.evaluation.repeats import Repeats
    from bench.reporting.tables import Figure

PATH_IDEALS = ("ideal-a", "ideal-b")
BELOW_LOAD = 0.1
"""If a path alone misses a larger share than this, its rate is below the offered load for that share of the time."""
WITH_BUDGET = ("plr-adaptive-10%", "plr-hedge-10%")


@dataclass(slots=True)
class Evidence:
    """The figures found."""

    figures: dict[str, Figure] = field(default_factory=dict)
    """Figures by name, without those that are not available."""
    notes: dict[str, str] = field(default_factory=dict)
    """The basis of each figure, by the same names."""

    def add(self, name: str, figure: Figure, note: str) -> None:
        """Add a figure and its basis."""
        self.figures[name] = figure
        self.notes[name] = note


def gather(outcomes: Sequence[Outcome], again: Measured | None = None) -> Evidence:
    """Compute all figures; `again` is another evaluation of the same windows."""
    found = Evidence()
    recorded = [one for one in outcomes if one.case == "A" and is_recorded(one.scenario)]
    _drives(found, recorded)
    windows = figures_by_window(outcomes)
    _queues(found, windows)
    _modes(found, windows)
    _budgets(found, outcomes)
    _fallback(found, [one for one in outcomes if one.case == "F"])
    _one_operator(found, [one for one in outcomes if one.case == "G"])
    if again is not None:
        _reproduced(found, repeats.compare(Measured.of(outcomes), again))
    return found


def _drives(found: Evidence, outcomes: Sequence[Outcome]) -> None:
    windows = figures_by_window(outcomes)
    complete = {name: runs for name, runs in windows.items() if runs.keys() >= {*DIRECT, SUREST, IDEAL}}
    recorded = len({one.scenario for one in outcomes})
    if recorded:
        found.add(
            "drive_windows", len(complete), f"of {recorded} windows; a window that is incomplete or void does not count"
        )
    gain = gains(complete).get(SUREST)
    if gain is not None:
        counted = f"median of the {gain.windows} windows in which a direct run misses a request"
        everywhere = (median(over_direct(complete.values(), SUREST, figure)) for figure in ("mean_ms", "p99_ms"))
        notes = (f"{counted}; median of all {len(complete)}: {value:.3g}" for value in everywhere)
        found.add("mean_gain", gain.median_mean_gain, next(notes))
        found.add("p99_gain", gain.median_p99_gain, next(notes))
    excess = {name: r[SUREST].miss_ratio - (1.1 * r[IDEAL].miss_ratio + 0.005) for name, r in complete.items()}
    if excess:
        worst = max(excess, key=lambda name: excess[name])
        ours, ideal = complete[worst][SUREST].miss_ratio, complete[worst][IDEAL].miss_ratio
        above = sum(value > 0 for value in excess.values())
        note = f"above 0 in {above} of {len(excess)} windows; worst {worst}: {SUREST} {ours:.1%}, ideal {ideal:.1%}"
        found.add("miss_excess", excess[worst], note)
    good = {name: r for name, r in complete.items() if not any(r[direct].miss_ratio for direct in DIRECT)}
    above_ms = {name: r[SUREST].p99_ms - (1.05 * r[IDEAL].p99_ms + 10) for name, r in good.items()}
    if above_ms:
        worst = max(above_ms, key=lambda name: above_ms[name])
        ours, ideal = good[worst][SUREST].p99_ms, good[worst][IDEAL].p99_ms
        note = f"{len(good)} such windows; worst {worst}: {SUREST} {ours:.0f} ms, ideal {ideal:.0f} ms"
        found.add("good_p99_excess_ms", above_ms[worst], note)


def _queues(found: Evidence, windows: Windows) -> None:
    complete = {name: runs for name, runs in windows.items() if runs.keys() >= {*PATH_IDEALS, IDEAL, SUREST}}
    queues = {n: r for n, r in complete.items() if any(r[path].miss_ratio > BELOW_LOAD for path in PATH_IDEALS)}
    if queues:
        below = sorted(name for name, runs in queues.items() if runs[SUREST].p99_ms < runs[IDEAL].p99_ms)
        found.add("queue_windows_below_ideal", len(below), f"of {len(queues)} such windows: {', '.join(below) or '-'}")
        found.figures["queue_windows"] = len(queues)


def _modes(found: Evidence, windows: Windows) -> None:
    costs = mode_costs(windows)
    adaptive, hedge = costs.get("plr-adaptive"), costs.get("plr-hedge")
    if adaptive is not None:
        avoided, extra = f"{adaptive.windows} windows", f"{adaptive.windows} windows"
        if hedge is not None:
            avoided += "" if hedge.avoided is None else f"; plr-hedge {hedge.avoided:.1%} ({hedge.windows} windows)"
            extra += f"; plr-hedge {hedge.extra_bytes:+.1%}"
        found.add("adaptive_avoided", adaptive.avoided, avoided)
        found.add("adaptive_extra_bytes", adaptive.extra_bytes, extra)


def _budgets(found: Evidence, outcomes: Sequence[Outcome]) -> None:
    shares = {
        (run.contender, run.scenario, interface): share
        for runs in by_window(outcomes).values()
        for run in runs.values()
        if run.contender in WITH_BUDGET
        for interface, share in counters.extra_share(run).items()
    }
    if shares:
        worst = max(shares, key=lambda key: shares[key])
        runs = len({key[:2] for key in shares})
        contender, scenario, interface = worst
        note = f"{runs} runs; worst: {contender} in {scenario}, interface {interface}"
        found.add("budget_extra_share", shares[worst], note)


def _fallback(found: Evidence, outcomes: Sequence[Outcome]) -> None:
    runs = [runs["plr-fallback"] for runs in by_window(outcomes).values() if "plr-fallback" in runs]
    if not runs:
        return
    late = sum(one.latency_s * MS > run.deadline_ms for run in runs for one in run.requests)
    requests = sum(len(run.requests) for run in runs)
    missed = [counters.missed_by_network(run) for run in runs]
    known = [count for count in missed if count is not None]
    missed_text = str(sum(known)) if len(known) == len(runs) else "unknown"
    note = f"of {requests} requests in {len(runs)} windows"
    note += f"; the network did not answer {missed_text} in time, including the warm-up"
    found.add("fallback_late", late, note)
    if len(known) == len(runs):
        found.figures["fallback_network_missed"] = sum(known)


def _one_operator(found: Evidence, outcomes: Sequence[Outcome]) -> None:
    windows = by_window(outcomes)
    ours = [runs[SUREST] for runs in windows.values() if SUREST in runs]
    if ours:
        named = [run for run in ours if _explains(run, Correlation.TOGETHER, Correlation.LIKELY)]
        sure = sum(_explains(run, Correlation.TOGETHER) for run in named)
        note = f"{len(named)} of {len(ours)} windows; it is sure in {sure} of them"
        found.add("one_operator_explained", len(named) / len(ours), note)
    beside = [
        (runs[ONE_RADIO].figures(), runs[SUREST].figures())
        for runs in windows.values()
        if runs.keys() >= {ONE_RADIO, SUREST}
    ]
    if beside:
        alone = median(one.miss_ratio for one, _ in beside) or 0.0
        missed = median(both.miss_ratio for _, both in beside) or 0.0
        found.add(
            "one_operator_mean_gain",
            one_radio_gain(figures_by_window(outcomes)),
            f"median of {len(beside)} windows; missed with both radios {missed:.1%}, with one {alone:.1%}",
        )
        found.figures["one_operator_missed"] = missed
        found.figures["one_radio_missed"] = alone


def _reproduced(found: Evidence, both: Repeats) -> None:
    if both.largest is not None:
        worst = both.ratios[both.largest]
        above = sum(one.difference > repeats.ALIKE for one in both.ratios.values())
        note = f"above {repeats.ALIKE} for {above} of {len(both.ratios)} ratios"
        note += f", from {both.runs} runs in {both.windows} windows"
        note += f"; largest for `{both.largest}`: {worst.first:.3g} and {worst.second:.3g}"
        found.add("reproduced_difference", worst.difference, note)


def _explains(run: Outcome, *correlations: Correlation) -> bool:
    endings = tuple(f": {one.value}" for one in correlations)
    return any(text.endswith(endings) for text in run.conditions.get("explained", ()))
