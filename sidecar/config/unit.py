"""Reads the installed systemd unit of the sidecar: as which user and with which environment it starts.

The unit's files are read directly: systemctl is not there in a container, and does not answer everybody.
"""

from __future__ import annotations

import errno
import os
import pwd
import re
import shlex
import stat
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from plr.protos.program.regular_file import open_regular

if TYPE_CHECKING:
    from collections.abc import Container, Iterator, Sequence

NAME = "plr-sidecar.service"
FOLDERS = tuple(
    map(
        Path, ("/etc/systemd/system", "/run/systemd/system", "/usr/local/lib/systemd/system", "/usr/lib/systemd/system")
    )
)
"""Where systemd looks for units, the most important first (systemd.unit(5))."""
MAX_BYTES = 1 << 16
MAX_DROP_INS = 64

_SPECIFIERS = {"%L": "/var/log", "%S": "/var/lib", "%C": "/var/cache", "%t": "/run", "%E": "/etc", "%%": "%"}
_SPECIFIER = re.compile(r"%.")


@dataclass(slots=True)
class Unit:
    """What the unit says, with its drop-ins."""

    path: Path
    user: str = "root"
    environment: dict[str, str] = field(default_factory=dict)
    command: str = ""
    unread: str = ""
    """Which of its files is not used, and why; empty if all are."""

    @property
    def user_id(self) -> int | None:
        """The number of its user; None if there is no such user."""
        try:
            return pwd.getpwnam(self.user).pw_uid
        except KeyError:
            return int(self.user) if self.user.isascii() and self.user.isdigit() else None


def installed(config: Path, folders: Sequence[Path] = FOLDERS) -> Unit | None:
    """Return the installed unit if it starts a sidecar with this configuration; a file of it counts if it is root's."""
    path = next((folder / NAME for folder in folders if (folder / NAME).exists()), None)
    if path is None:
        return None
    unit = Unit(path)
    for file in (path, *_drop_ins(folders)):
        try:
            _, text = read_trusted(file, {0})
        except (OSError, ValueError) as error:
            unit.unread = unit.unread or f"{file} is not used: {getattr(error, 'strerror', None) or error}"
            continue
        _take(unit, text)
    try:
        words = shlex.split(unit.command)
    except ValueError:
        return None
    return unit if str(config) in words or f"--config={config}" in words else None


def _drop_ins(folders: Sequence[Path]) -> list[Path]:
    named: dict[str, Path] = {}
    for folder in folders:
        for path in sorted((folder / f"{NAME}.d").glob("*.conf")):
            named.setdefault(path.name, path)
    return [named[name] for name in sorted(named)][:MAX_DROP_INS]


def _take(unit: Unit, text: str) -> None:
    for key, value in _service_settings(text):
        if key == "User":
            unit.user = value or "root"
        elif key == "ExecStart":
            unit.command = value
        elif key == "Environment" and not value:
            unit.environment.clear()
        elif key == "Environment":
            unit.environment.update(_variables(value))


def _service_settings(text: str) -> Iterator[tuple[str, str]]:
    section = ""
    for line in re.sub(r"\\\n", " ", text).splitlines():
        line = line.strip()
        if line.startswith("["):
            section = line
        elif section == "[Service]" and not line.startswith(("#", ";")) and "=" in line:
            key, _, value = line.partition("=")
            yield key.strip(), value.strip()


def _variables(value: str) -> Iterator[tuple[str, str]]:
    try:
        words = shlex.split(value)
    except ValueError:
        return
    for word in words:
        name, separator, text = word.partition("=")
        if separator and not set(_SPECIFIER.findall(text)) - _SPECIFIERS.keys():
            yield name, _SPECIFIER.sub(lambda found: _SPECIFIERS[found[0]], text)


def read_trusted(path: Path, owners: Container[int]) -> tuple[int, str]:
    """Return owner and text of a file that only `owners` can have written; raise OSError or ValueError."""
    folder = os.open(path.parent, os.O_PATH | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        with open_regular(Path(path.name), folder=folder) as file:
            _refuse_untrusted("its folder", os.fstat(folder), owners)
            status = os.fstat(file.fileno())
            _refuse_untrusted("it", status, owners)
            data = file.read(MAX_BYTES)
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
