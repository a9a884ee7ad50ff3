"""Reads the host itself: the kernel's clock, sysctls, the unit's environment. No privileges are needed."""

from __future__ import annotations

import ctypes
import errno
import os
import re
import stat
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from plr.protos.program.regular_file import open_regular

if TYPE_CHECKING:
    from collections.abc import Container

STA_UNSYNC = 0x0040
CLOCK_KEPT_S = 16.0
"""The kernel's error bound grows to this if nothing disciplines the clock (ntp_adjtime(3): NTP_PHASE_LIMIT)."""
ENVIRONMENT_FILE = "sidecar.env"
MAX_ENVIRONMENT_BYTES = 1 << 16
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
    """Parts of `sidecar.env` that are not used, and why; empty if all are used."""


def unit_environment(config: Path) -> UnitEnvironment:
    """Read `sidecar.env` beside the configuration; it overrides this shell's environment.

    A program is run with it, so it is used only if nobody but root, this user, or the configuration's owner can have
    written it. From the last, only plain ROS settings are taken: the owner must not run code as this user.
    """
    environment = dict(os.environ)
    path = config.with_name(ENVIRONMENT_FILE)
    try:
        owner, text = _read_trusted(path, {0, os.geteuid(), config.stat().st_uid})
    except FileNotFoundError:
        return UnitEnvironment(environment)
    except (OSError, ValueError) as error:
        return UnitEnvironment(environment, f"{path} is not used: {getattr(error, 'strerror', None) or error}")
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
        return UnitEnvironment(environment)
    names = " ".join(sorted(refused))[:MAX_NAMES_CHARACTERS]
    return UnitEnvironment(environment, f"{path} belongs to user {owner}; these variables in it are not used: {names}")


def _read_trusted(path: Path, owners: Container[int]) -> tuple[int, str]:
    """Return owner and text of a file that only `owners` can have written; raise OSError or ValueError."""
    folder = os.open(path.parent, os.O_PATH | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        with open_regular(Path(path.name), folder=folder) as file:
            _refuse_untrusted("its folder", os.fstat(folder), owners)
            status = os.fstat(file.fileno())
            _refuse_untrusted("it", status, owners)
            data = file.read(MAX_ENVIRONMENT_BYTES)
            if b"\0" in data:
                raise OSError(errno.EINVAL, "it contains a NUL byte, as after a power cut: write it again")
            return status.st_uid, data.decode()
    finally:
        os.close(folder)


def _refuse_untrusted(what: str, status: os.stat_result, owners: Container[int]) -> None:
    if status.st_uid not in owners:
        raise OSError(errno.EPERM, f"{what} belongs to user {status.st_uid}, who is not the configuration's owner")
    if status.st_mode & (stat.S_IWGRP | stat.S_IWOTH):
        raise OSError(errno.EPERM, f"others may write to {what}: chmod go-w")
