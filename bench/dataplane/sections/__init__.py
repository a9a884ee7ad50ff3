"""What is measured: a module for each section, each with a `measure(context)`."""

from __future__ import annotations

from bench.dataplane.sections import blackhole, goodput, one_way

SECTIONS = (one_way.SECTION, goodput.SECTION, blackhole.SECTION)
"""In the order in which they run."""
