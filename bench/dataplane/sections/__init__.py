"""The sections, one module each with a `measure(context)`."""

from __future__ import annotations

from bench.dataplane.sections import (
    blackhole,
    busy,
    flood,
    goodput,
    keys,
    loss,
    one_way,
    outage,
    overload,
    ros_calls,
    share,
)

SECTIONS = (
    one_way.SECTION,
    goodput.SECTION,
    ros_calls.SECTION,
    blackhole.SECTION,
    busy.SECTION,
    loss.SECTION,
    overload.SECTION,
    outage.SECTION,
    share.SECTION,
    flood.SECTION,
    keys.SECTION,
)
"""The sections in the order in which they run."""
