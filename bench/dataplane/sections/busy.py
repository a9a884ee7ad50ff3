"""Measures small requests while the processors of robot and cloud are busy with other programs.

50 requests a second of 1 kB go over two plain cables, beside as many computing programs as there are processors: once
with normal scheduling, once with the real-time priority that `deploy/systemd/realtime.conf` gives the sidecar.
"""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
from typing import TYPE_CHECKING

from bench.dataplane.ours import Ours
from bench.dataplane.section import Findings, Section, table_of
from bench.dataplane.statistics import Row, median, ratio
from bench.dataplane.steady import realtime
from bench.dataplane.topology import cables
from lab import Lab

if TYPE_CHECKING:
    from collections.abc import Iterator

    from bench.dataplane.section import Context

SIZE = 1_000
RATE_HZ = 50.0
COUNT = 400
WARM_UP = 50


def measure(context: Context) -> Findings:
    """Measure."""
    rows: dict[str, list[Row]] = {"as any program": [], "real-time priority": []}
    count = context.scaled(COUNT)
    with Lab(cables()) as lab:
        for repeat in range(context.repeats):
            for name, before in zip(rows, ((), realtime()), strict=True):
                context.say(f"busy: {name}, {repeat + 1} of {context.repeats}")
                with Ours.in_lab(lab, context.folder, answer_bytes=SIZE, before=before) as ours:
                    ours.call(size=SIZE, count=WARM_UP, rate_hz=RATE_HZ)
                    with _computing():
                        calls = ours.call(size=SIZE, count=count, rate_hz=RATE_HZ)
                    rows[name].append(calls.row(name))
    ordinary, preferred = ([row.p99_ms for row in repeats] for repeats in rows.values())
    return Findings(
        figures={
            "busy_p99_ms": median(ordinary),
            "busy_realtime_p99_ms": median(preferred),
            "busy_p99_over_realtime": median(ratio(*pair) for pair in zip(ordinary, preferred, strict=True)),
            "busy_lost": sum(row.lost for repeats in rows.values() for row in repeats),
        },
        tables=[table_of("1 kB at 50 Hz, all processors busy", [Row.of_repeats(each) for each in rows.values()])],
    )


@contextlib.contextmanager
def _computing() -> Iterator[None]:
    """Run as many programs that never pause as there are processors."""
    programs = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(os.cpu_count() or 1)]
    try:
        yield
    finally:
        for program in programs:
            program.kill()
            program.wait()


SECTION = Section("busy", "Requests on busy processors", measure)
