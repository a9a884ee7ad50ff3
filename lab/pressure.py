"""Measures how much the machine itself interfered: the kernel's CPU pressure over a period."""

from __future__ import annotations

import time
from pathlib import Path

_PRESSURE = Path("/proc/pressure/cpu")
BUSY_SHARE = 0.5
"""Above this share of time, programs waited for a processor often enough to spoil latencies of tens of ms."""


class CpuPressure:
    """Share of the time since creation during which some program was ready but had no processor."""

    def __init__(self) -> None:
        self._started = time.monotonic()
        self._before_us = _total_us()

    def share(self) -> float | None:
        """Return the share in [0, 1]; None if the kernel does not report it (PSI is off)."""
        after_us = _total_us()
        if self._before_us is None or after_us is None:
            return None
        return min(1.0, (after_us - self._before_us) / 1e6 / max(time.monotonic() - self._started, 1e-3))


def _total_us() -> int | None:
    try:
        some = _PRESSURE.read_text().splitlines()[0]
    except (OSError, IndexError):
        return None
    return int(some.rpartition("total=")[2])
