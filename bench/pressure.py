"""How much the machine itself was in the way: the kernel's CPU pressure over a stretch of time."""

from __future__ import annotations

import time
from pathlib import Path

_PRESSURE = Path("/proc/pressure/cpu")
BUSY_SHARE = 0.5
"""Above this share of time some program waited for a processor often enough to spoil latencies of tens of ms."""


class CpuPressure:
    """Share of the time since it was made in which some program was ready but had no processor."""

    def __init__(self) -> None:
        self._started = time.monotonic()
        self._before_us = _total_us()

    def share(self) -> float | None:
        """In [0, 1]; None where the kernel does not tell (PSI is off)."""
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
