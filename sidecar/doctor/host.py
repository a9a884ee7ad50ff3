"""What is read of the host itself: kernel's clock, sysctls. No privileges are needed."""

from __future__ import annotations

import ctypes
import os
from dataclasses import dataclass
from pathlib import Path

from protos.regular_file import open_regular

STA_UNSYNC = 0x0040
CLOCK_KEPT_S = 16.0
"""The kernel's bound of its error grows to this where nobody keeps the clock (ntp_adjtime(3): NTP_PHASE_LIMIT)."""
MAX_ENVIRONMENT_BYTES = 1 << 16
CONF = Path("/proc/sys/net/ipv4/conf")


class _Timex(ctypes.Structure):
    """The beginning of struct timex of adjtimex(2); the rest is room for what the kernel writes after it."""

    _fields_ = (
        ("modes", ctypes.c_uint),
        ("offset", ctypes.c_long),
        ("freq", ctypes.c_long),
        ("maxerror", ctypes.c_long),
        ("esterror", ctypes.c_long),
        ("status", ctypes.c_int),
        ("rest", ctypes.c_byte * 512),
    )


@dataclass(frozen=True, slots=True)
class ClockState:
    """What the kernel says of its clock."""

    synchronised: bool
    error_s: float
    """At most so wrong, as whoever keeps it believes."""


def clock_state() -> ClockState | None:
    """Ask the kernel whether somebody (chrony, systemd-timesyncd, ntpd) keeps its clock; None: it does not say."""
    timex = _Timex()
    try:
        answer = ctypes.CDLL(None, use_errno=True).adjtimex(ctypes.byref(timex))
    except (OSError, AttributeError):
        return None
    if answer < 0:
        return None
    return ClockState(not timex.status & STA_UNSYNC, min(timex.maxerror / 1e6, CLOCK_KEPT_S))


def reverse_path_filter(interface: str, conf: Path = CONF) -> int | None:
    """Return the filter in force on an interface (0 off, 1 strict, 2 loose): the larger of `all` and its own."""
    values = [_number(conf / name / "rp_filter") for name in ("all", interface)]
    known = [value for value in values if value is not None]
    return max(known) if known else None


def _number(path: Path) -> int | None:
    try:
        return int(path.read_text())
    except (OSError, ValueError):
        return None


def unit_environment(config: Path) -> dict[str, str]:
    """Return the environment in which the unit of a configuration in /etc starts, as far as its files tell.

    What stands in `sidecar.env` beside the configuration wins over this shell's.
    """
    environment = dict(os.environ)
    try:
        with open_regular(config.with_name("sidecar.env")) as file:
            lines = file.read(MAX_ENVIRONMENT_BYTES).decode().splitlines()
    except (OSError, ValueError):
        return environment
    for line in lines:
        key, separator, value = line.strip().partition("=")
        if separator and not key.startswith(("#", ";")):
            environment[key.strip()] = value.strip().strip("\"'")
    return environment
