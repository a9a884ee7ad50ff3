"""Section `calibration`: do predicted miss ratios match those observed, and does it help to choose by them?"""

from __future__ import annotations

import os
from concurrent.futures import ProcessPoolExecutor
from statistics import fmean
from typing import TYPE_CHECKING

from bench.dataplane.section import Findings, Plot
from bench.matcher.calibration import (
    DEADLINES_S,
    FEWEST_MISSES,
    KINDS,
    Cell,
    cells_of,
    paired,
    predict,
    share_calibrated,
)
from bench.matcher.choosing import RIVALS, Chosen, choose
from bench.matcher.races import replay, workloads_for
from bench.matcher.sources import load
from bench.reporting.tables import Figure, Table

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path

    from lab.traces import Trace

SHOWN_MISFITS = 12


def measure(folder: Path | None, say: Callable[[str], None], *, quick: bool) -> Findings:
    """Replay every trace (of many of a family, one, if `quick`)."""
    traces, note = load(folder)
    if quick:
        traces = list({trace.name.rpartition("-")[0]: (trace, kind) for trace, kind in traces}.values())
    cells: list[Cell] = []
    chosen: list[Chosen] = []
    with ProcessPoolExecutor(os.cpu_count()) as pool:
        for (trace, _), found in zip(traces, pool.map(_cells, traces), strict=True):
            say(f"calibration: {trace.name}")
            cells += found[0]
            chosen += found[1]
    findings = Findings(notes=[note] if note else [])
    findings.figures = _figures(cells, len(traces)) | _choice_figures(chosen)
    findings.tables = [_by_deadline(cells), _by_family(cells), _misfits(cells), _choices(chosen)]
    findings.plots = [_plot(cells)]
    return findings


def _cells(source: tuple[Trace, str]) -> tuple[list[Cell], list[Chosen]]:
    trace, kind = source
    cells: list[Cell] = []
    chosen: list[Chosen] = []
    for workload in workloads_for(kind):
        races = replay(trace, workload)
        for deadline_s in DEADLINES_S:
            predicted = predict(races, deadline_s)
            cells += cells_of(races, deadline_s, predicted)
            chosen.append(choose(races, predicted))
    return cells, chosen


def _choice_figures(chosen: Sequence[Chosen]) -> dict[str, Figure]:
    matcher = sum(one.misses["matcher"] for one in chosen)
    figures: dict[str, Figure] = {}
    for rival in RIVALS:
        misses = sum(one.misses[rival] for one in chosen)
        figures[f"choice_over_{rival.lower().replace(' ', '_')}"] = matcher / misses if misses else None
    minutes = sum(one.duration_s for one in chosen) / 60.0
    figures["choice_switches_per_minute"] = sum(one.switches for one in chosen) / minutes if minutes else None
    return figures


def _choices(chosen: Sequence[Chosen]) -> Table:
    requests = sum(one.requests for one in chosen)
    rows = [(name, sum(one.misses[name] for one in chosen) / requests) for name in ("matcher", *RIVALS)]
    switches = sum(one.switches for one in chosen)
    return Table(f"one path at a time, miss ratio; the matcher switched {switches} times", ("", "missed"), tuple(rows))


def _figures(cells: Sequence[Cell], traces: int) -> dict[str, Figure]:
    pairs = paired(cells)
    figures: dict[str, Figure] = {
        "calibration_traces": traces,
        "calibration_cells": sum(cell.expected >= FEWEST_MISSES for cell in cells),
        "calibration_share": share_calibrated([cell for cell in cells if cell.kind != "product"]),
        "calibration_log_error_product": fmean(one.log_error for one, _ in pairs) if pairs else None,
        "calibration_log_error_joint": fmean(other.log_error for _, other in pairs) if pairs else None,
    }
    joint, product = figures["calibration_log_error_joint"], figures["calibration_log_error_product"]
    figures["calibration_joint_over_product"] = joint / product if joint is not None and product else None
    for kind, names in (("single", ("a", "b")), ("product", ("product",)), ("joint", ("joint",))):
        figures[f"calibration_share_{kind}"] = share_calibrated([cell for cell in cells if cell.kind in names])
    return figures


def _row(name: str, cells: Sequence[Cell]) -> tuple[str | Figure, ...]:
    requests = sum(cell.requests for cell in cells)
    judged = [cell for cell in cells if cell.expected >= FEWEST_MISSES]
    return (
        name,
        sum(cell.expected for cell in cells) / requests,
        sum(cell.observed for cell in cells) / requests,
        sum(cell.low for cell in cells) / requests,
        sum(cell.high for cell in cells) / requests,
        len(judged),
        sum(cell.inside for cell in judged) / len(judged) if judged else None,
        sum(cell.near for cell in judged) / len(judged) if judged else None,
        share_calibrated(judged),
    )


_COLUMNS = ("", "predicted", "observed", "from", "to", "cells", "inside", "near", "either")


def _by_deadline(cells: Sequence[Cell]) -> Table:
    rows = [
        _row(f"{deadline_s * 1e3:.0f} ms, {kind}", [c for c in cells if (c.deadline_s, c.kind) == (deadline_s, kind)])
        for deadline_s in DEADLINES_S
        for kind in KINDS
    ]
    return Table("miss ratios by deadline, all traces", _COLUMNS, tuple(rows))


def _by_family(cells: Sequence[Cell]) -> Table:
    families = list(dict.fromkeys(_family(cell) for cell in cells))
    rows = [
        _row(f"{family}, {kind}", [cell for cell in cells if (_family(cell), cell.kind) == (family, kind)])
        for family in families
        for kind in KINDS
    ]
    return Table("miss ratios by family of traces, all deadlines", _COLUMNS, tuple(rows))


def _family(cell: Cell) -> str:
    name = cell.trace.rstrip("0123456789-")
    return f"{name} {cell.workload}"


def _misfits(cells: Sequence[Cell]) -> Table:
    wrong = [cell for cell in cells if cell.expected >= FEWEST_MISSES and not (cell.inside or cell.near)]
    wrong.sort(key=lambda cell: -cell.log_error)
    rows = tuple(
        (
            f"{cell.trace} {cell.workload} {cell.deadline_s * 1e3:.0f} ms {cell.kind}",
            cell.requests,
            cell.expected,
            cell.observed,
        )
        for cell in wrong[:SHOWN_MISFITS]
    )
    return Table(f"worst of {len(wrong)} cells that do not fit", ("", "requests", "expected", "observed"), rows)


def _plot(cells: Sequence[Cell]) -> Plot:
    judged = [cell for cell in cells if cell.expected >= FEWEST_MISSES]
    points = {
        name: [(cell.expected / cell.requests, cell.observed / cell.requests) for cell in judged if cell.kind in kinds]
        for name, kinds in (("single", ("a", "b")), ("product", ("product",)), ("joint", ("joint",)))
    }
    return Plot("predicted and observed miss ratio, a point for each cell", "predicted", "observed", points=points)
