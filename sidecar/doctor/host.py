"""Reads the host itself: the kernel's clock, sysctls, the unit's environment. No privileges are needed."""

from __future__ import annotations

import ctypes
import os
import re
from dataclasses import dataclass, replace
from pathlib import Path

from plr.sidecar.config.unit import installed, read_trusted

STA_UNSYNC = 0x0040
CLOCK_KEPT_S = 16.0
"""The kernel's error bound grows to this if nothing disciplines the clock (ntp_adjtime(3): NTP_PHASE_LIMIT)."""
ENVIRONMENT_FILE = "sidecar.env"
MAX_NAMES_CHARACTERS = 200
CONF = Path("/proc/sys/net/ipv4/conf")

_TELLS_OF_ROS = frozenset(
    {
        "ROS_DOMAIN_ID",
        "RMW_IMPLEMENTATION",
        "ROS_AUTOMATIC_DISCOVERY_RANGE",
        "ROS_LOCALHOST_ONLY",
        "ROS_STATIC_PEERS",
    }
)
"""Variables that name no file; PATH, PYTHONPATH, LD_PRELOAD, AMENT_PREFIX_PATH and many more can run code."""
_OF_THE_SHELL = re.compile(
    r"(ROS|RMW|FASTRTPS|FASTDDS|CYCLONEDDS|AMENT|COLCON)_.*|CYCLONEDDS_URI|PYTHONPATH|LD_LIBRARY_PATH|CMAKE_PREFIX_PATH"
)
"""Variables that steer ROS: a unit does not inherit them from a shell."""
_NOT_TRIED = "ROS_LOG_DIR"
"""Belongs to the service's user: this one may not write there."""
_PLAIN_VALUE = re.compile(r"[A-Za-z0-9_.:;, -]*")


class _Timex(ctypes.Structure):
    """Start of struct timex of adjtimex(2); `rest` is room for what the kernel writes after it."""

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
    """What the kernel says about its clock."""

    synchronised: bool
    error_s: float
    """Maximum error, as estimated by the program that disciplines the clock."""


def clock_state() -> ClockState | None:
    """Ask the kernel whether a program (chrony, systemd-timesyncd, ntpd) disciplines its clock; None: unknown."""
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


@dataclass(frozen=True, slots=True)
class UnitEnvironment:
    """The environment in which the unit of a configuration in /etc starts, as far as its files show."""

    variables: dict[str, str]
    refused: str = ""
    """Parts of `sidecar.env` or the unit that are not used, and why; empty if all are used."""
    of_unit: bool = False
    """Whether there is a unit for this configuration; if not, this shell's environment is the base."""
    user: int | None = None
    """As whom the unit starts the sidecar."""


def unit_environment(config: Path) -> UnitEnvironment:
    """Read `Environment=` of the installed unit and `sidecar.env` beside the configuration, which overrides it.

    Without a unit that starts this configuration, `sidecar.env` overrides this shell's environment.

    A program is run with them, so a file is used only if nobody but root, this user, or the configuration's owner can
    have written it; the unit only if it is root's. From the configuration's owner, only plain ROS settings are taken:
    he must not run code as this user.
    """
    unit = installed(config)
    if unit is None:
        return _with_file(config, UnitEnvironment(dict(os.environ)))
    variables = {name: value for name, value in os.environ.items() if not _OF_THE_SHELL.fullmatch(name)}
    variables |= {name: value for name, value in unit.environment.items() if name != _NOT_TRIED}
    return _with_file(config, UnitEnvironment(variables, unit.unread, of_unit=True, user=unit.user_id))


def _with_file(config: Path, base: UnitEnvironment) -> UnitEnvironment:
    environment = dict(base.variables)
    path = config.with_name(ENVIRONMENT_FILE)
    try:
        owner, text = read_trusted(path, {0, os.geteuid(), config.stat().st_uid})
    except FileNotFoundError:
        return base
    except (OSError, ValueError) as error:
        return replace(base, refused=f"{path} is not used: {getattr(error, 'strerror', None) or error}")
    foreign = owner not in (0, os.geteuid())
    refused = set()
    for line in text.splitlines():
        key, separator, value = (part.strip() for part in line.strip().partition("="))
        if not separator or key.startswith(("#", ";")):
            continue
        value = value.strip("\"'")
        if foreign and not (key in _TELLS_OF_ROS and _PLAIN_VALUE.fullmatch(value)):
            refused.add(key)
        else:
            environment[key] = value
    if not refused:
        return replace(base, variables=environment)
    names = " ".join(sorted(refused))[:MAX_NAMES_CHARACTERS]
    told = f"{path} belongs to user {owner}; these variables in it are not used: {names}"
    return replace(base, variables=environment, refused=told)
