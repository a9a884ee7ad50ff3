"""Records the load of the machine itself: other users of it may be the reason why requests are late."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

from lab.pressure import CpuPressure

_STAT = Path("/proc/stat")
_IDLE = slice(3, 5)
_STOLEN = 7
"""Fields of the `cpu` line of /proc/stat (proc(5))."""


@dataclass(frozen=True, slots=True)
class Load:
    """Shares of the time between two measurements, in [0, 1]."""

    at_s: float
    busy: float
    """Share of all processors at work, for any program."""
    stolen: float
    """Share of all processors that the host gave to other machines although this one had work."""
    waiting: float | None
    """Share of time in which some program had no processor; None if the kernel does not report it."""

    def __str__(self) -> str:
        waiting = "" if self.waiting is None else f", {self.waiting:.0%} of the time somebody waits for one"
        return f"processors: {self.busy:.0%} busy, {self.stolen:.0%} stolen{waiting}"


class Machine:
    """Measures the machine's load, each time since the previous measurement."""

    def __init__(self) -> None:
        self.loads: list[Load] = []
        self._before = _ticks()
        self._pressure = CpuPressure()

    def look(self, at_s: float) -> Load:
        """Note and return the load since the last call."""
        now = _ticks()
        spent = [after - before for after, before in zip(now, self._before, strict=True)]
        total = max(sum(spent), 1)
        load = Load(at_s, 1 - sum(spent[_IDLE]) / total, spent[_STOLEN] / total, self._pressure.share())
        self.loads.append(load)
        self._before, self._pressure = now, CpuPressure()
        return load


def processor_s(pid: int) -> float:
    """Return the processor time that a process has used; 0 if it is gone."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return 0.0
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def _ticks() -> list[int]:
    return [int(field) for field in _STAT.read_text().splitlines()[0].split()[1:9]]
