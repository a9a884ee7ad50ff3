"""Says whether the account of the service may read what root just read.

Root reads everything, so a check by root alone says nothing about the start of the service.
"""

from __future__ import annotations

import os
import pwd
import shlex
import stat
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from plr.protos.program.tls_files import CA_FILE, CERTIFICATE_FILE, CRL_FILE, KEY_FILE
from plr.sidecar.config.unit import installed

if TYPE_CHECKING:
    from collections.abc import Container, Iterable

    from plr.sidecar.config.unit import Unit

ACCOUNT = "plr"
"""The user of the shipped unit."""
PREFIX = Path("/opt/plr")
"""Where the pages install the program."""
MAX_PACKAGES = 1024
"""Entries of its site-packages that are looked at."""
MAX_SHOWN = 3
"""Unreadable paths that are named."""
_ACL = "system.posix_acl_access"


@dataclass(frozen=True, slots=True)
class Unreadable:
    """What the service's account may not read."""

    text: str
    remedy: str


def unreadable(config: Path, tls_dir: Path | None) -> Unreadable | None:
    """Return what the service's account may not read, if this is root and there is such an account."""
    if os.geteuid() != 0:
        return None
    unit = installed(config)
    try:
        account = pwd.getpwnam(ACCOUNT if unit is None else unit.user)
    except KeyError:
        return None
    groups = frozenset(os.getgrouplist(account.pw_name, account.pw_gid))
    files = [config.absolute()]
    if tls_dir is not None:
        files += [tls_dir / name for name in (CERTIFICATE_FILE, KEY_FILE, CA_FILE, CRL_FILE)]
    return _judge(account.pw_name, files, tls_dir, blocking(files, account.pw_uid, groups))


def _judge(name: str, files: Iterable[Path], tls_dir: Path | None, blocked: list[Path]) -> Unreadable | None:
    if not blocked:
        return None
    text = f"the account {name}, which runs the service, may not read {', '.join(map(str, blocked))}"
    own = {*files, tls_dir}
    if set(blocked) <= own:
        folder = tls_dir if tls_dir is not None and any(tls_dir in (one, one.parent) for one in blocked) else None
        rest = [one for one in blocked if folder not in (one, one.parent)]
        commands = [] if folder is None else [f"chown -R {name} {folder}"]
        return Unreadable(text, " && ".join(commands + [f"chown {name} {one}" for one in rest]))
    return Unreadable(text, "move the files to a folder that it may enter, such as /etc/plr/tls")


def unreadable_program(config: Path) -> Unreadable | None:
    """Return what of the installed program the service's account may not read, if this is root.

    An installation with umask 077 leaves such files: root runs the program, and the service does not start.
    """
    if os.geteuid() != 0:
        return None
    unit = installed(config)
    program = _program(unit)
    if program is None:
        return None
    prefix = program.parent.parent
    packages = sorted(prefix.glob("lib/python3*/site-packages/*"))[:MAX_PACKAGES]
    files = [program, program.with_name("python"), prefix / "pyvenv.cfg"]
    files += [path / "__init__.py" if (path / "__init__.py").exists() else path for path in packages]
    profile = (unit.environment if unit is not None else {}).get("FASTRTPS_DEFAULT_PROFILES_FILE")
    files += [Path(profile)] if profile else []
    try:
        account = pwd.getpwnam(ACCOUNT if unit is None else unit.user)
    except KeyError:
        return None
    blocked = blocking(files, account.pw_uid, frozenset(os.getgrouplist(account.pw_name, account.pw_gid)))
    if not blocked:
        return None
    shown = ", ".join(map(str, blocked[:MAX_SHOWN]))
    shown += f" and {len(blocked) - MAX_SHOWN} more" if len(blocked) > MAX_SHOWN else ""
    ours = [path for path in blocked if path == prefix or prefix in path.parents]
    others = [f"chmod a+rX {path}" for path in blocked if path not in ours]
    return Unreadable(
        f"the account {account.pw_name}, which runs the service, may not read {shown}, as after an installation with "
        "umask 077: the service does not start",
        " && ".join([f"chmod -R a+rX {prefix}"] * bool(ours) + others),
    )


def _program(unit: Unit | None) -> Path | None:
    """Return the program that the unit starts; without a unit, this one, if it is installed where the pages say."""
    if unit is None:
        return PREFIX / "bin" / "plr-sidecar" if Path(sys.prefix) == PREFIX else None
    words = shlex.split(unit.command)
    program = Path(words[0].lstrip("-@:+!")) if words else Path()
    return program if program.is_absolute() else None


def blocking(files: Iterable[Path], user: int, groups: Container[int]) -> list[Path]:
    """Return the files that a user may not read, or the folders on the way that he may not enter; each once."""
    if user == 0:
        return []
    found: dict[Path, None] = {}
    for file in files:
        for path, wanted in (*((folder, os.X_OK) for folder in reversed(file.parents)), (file, os.R_OK)):
            try:
                refused = not _may(path, wanted, user, groups)
            except OSError:
                break  # it does not exist: others report that
            if refused:
                found[path] = None
                break
    return list(found)


def _may(path: Path, wanted: int, user: int, groups: Container[int]) -> bool:
    status = path.stat()
    mode = stat.S_IMODE(status.st_mode)
    if status.st_uid == user:
        return bool(mode >> 6 & wanted)
    if _has_acl(path):
        return True  # it may name the user
    return bool((mode >> 3 if status.st_gid in groups else mode) & wanted)


def _has_acl(path: Path) -> bool:
    try:
        return bool(os.getxattr(path, _ACL))
    except OSError:
        return False
