"""`python -m bench fleet-day`."""

from __future__ import annotations

import json
import tempfile
import time
import tracemalloc
from pathlib import Path
from typing import TYPE_CHECKING

from rich.console import Console

from bench.fleetday.day import Day, Sample, Scale
from bench.reporting.machine import machine

if TYPE_CHECKING:
    import argparse

SHOWN_TABLES = 40
"""Tables shown, the largest ones."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of `python -m bench fleet-day`."""
    whole = Scale()
    parser.add_argument("--members", type=int, default=whole.members, help="number of sidecars (default %(default)s)")
    parser.add_argument("--hours", type=float, default=whole.hours, help="simulated hours (default %(default)s)")
    parser.add_argument("--seed", type=int, default=1, help="seed of everything that happens (default %(default)s)")
    parser.add_argument("--trace-memory", action="store_true", help="count all memory by tracemalloc; slow")
    parser.add_argument(
        "--out", type=Path, default=Path("bench/results"), help="folder for fleet-day.json (default %(default)s)"
    )


def run(options: argparse.Namespace) -> int:
    """Run through the day, write fleet-day.json and return the exit code: 1 if anything drifted or grew."""
    console = Console(highlight=False, soft_wrap=True)
    scale = Scale(members=options.members, hours=options.hours, every_hours=options.hours / 6.0)
    if options.trace_memory:
        tracemalloc.start()
    traced: list[int] = []
    with tempfile.TemporaryDirectory(prefix="plr-day-") as folder:
        day = Day(options.seed, scale, Path(folder))
        began = time.process_time()

        def show(sample: Sample) -> None:
            if options.trace_memory:
                traced.append(tracemalloc.get_traced_memory()[0])
            console.print(
                f"{sample.at_h:5.1f} h: {sample.registered} registered, {sample.judged} judged, core"
                f" {sample.sizes.total_bytes / 1e6:.1f} MB, sidecars' ends {sample.sidecars.total_bytes / 1e6:.1f} MB,"
                f" {sample.events_kept} events in {sample.log_bytes / 1e6:.2f} MB on disk,"
                + (f" {traced[-1] / 1e6:.0f} MB traced," if traced else "")
                + f" {day.checker.complaints_in_all} complaints, {time.process_time() - began:.0f} s of processor"
            )

        day.on_sample = show
        day.run()
        took_s = time.process_time() - began
    _show_tables(console, day.samples)
    growing = day.grown()
    for line in (*day.checker.complaints[:20], *growing):
        console.print(line)
    figures = {
        "members": scale.members,
        "hours": scale.hours,
        "processor_s": round(took_s, 1),
        "actions": day.timeline.done,
        "actions_per_s": round(day.timeline.done / took_s),
        "happened": dict(day.happened.most_common()),
        "solved": day.plane.solved,
        "messages_to_sidecars": day.plane.sent,
        "messages_to_control_plane": day.plane.received,
        "looks": day.checker.looks,
        "sidecars_judged": day.checker.judged,
        "peers_compared": day.checker.compared,
        "judged_after_last_restart": day.judged_at_last,
        "complaints": day.checker.complaints_in_all,
        "grown_tables": growing,
        "core_mb": [round(sample.sizes.total_bytes / 1e6, 2) for sample in day.samples],
        "traced_mb": [round(size / 1e6, 1) for size in traced],
    }
    options.out.mkdir(parents=True, exist_ok=True)
    path = options.out / "fleet-day.json"
    path.write_text(json.dumps({"machine": machine(), **figures}, indent=2, default=str) + "\n")
    console.print(
        f"{day.timeline.done} actions in {took_s:.0f} s of processor: {day.timeline.done / took_s:.0f} a second"
    )
    console.print(f"figures: {path}")
    return 1 if day.checker.complaints_in_all or growing else 0


def _show_tables(console: Console, samples: list[Sample]) -> None:
    """Show the entries of the largest tables, and bytes below each attribute of the core, at each measurement."""
    console.print("entries of the core's tables at " + ", ".join(f"{sample.at_h:g} h" for sample in samples))
    names = {name for sample in samples for name in sample.sizes.entries}
    largest = sorted(names, key=lambda name: -max(sample.sizes.entries.get(name, 0) for sample in samples))
    for name in largest[:SHOWN_TABLES]:
        console.print(f"  {name}: " + " ".join(str(sample.sizes.entries.get(name, 0)) for sample in samples))
    console.print("kilobytes below each attribute of the core")
    for name in sorted({name for sample in samples for name in sample.sizes.bytes}):
        kilobytes = [sample.sizes.bytes.get(name, 0) // 1000 for sample in samples]
        if max(kilobytes) >= 10:
            console.print(f"  {name}: " + " ".join(map(str, kilobytes)))
