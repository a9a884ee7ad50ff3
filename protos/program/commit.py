"""Finds the commit of this code: recorded when a wheel is built, or taken from git in a checkout."""

from __future__ import annotations

import functools
import subprocess
from importlib import metadata
from pathlib import Path

DISTRIBUTION = "fogros2-plr"
STAMP = "commit.txt"
GIT_TIMEOUT_S = 5.0


@functools.cache
def commit() -> str | None:
    """Return the commit, with -dirty if files differ from it, or None if unknown; asks git in a checkout."""
    folder = Path(__file__).resolve().parent
    try:
        return (folder / STAMP).read_text().strip() or None
    except (OSError, UnicodeDecodeError):
        return _asked_of_git(folder.parents[1])


def version() -> str:
    """Return the version of the installed distribution and the commit; unknown parts are left out."""
    try:
        release = metadata.version(DISTRIBUTION)
    except metadata.PackageNotFoundError:
        release = "from source"
    made_of = commit()
    return f"{release}+{made_of}" if made_of is not None else release


def _asked_of_git(checkout: Path) -> str | None:
    # An environment may lie inside another project's checkout, whose commit is not ours.
    if not (checkout / ".git").exists():
        return None
    # If root runs another user's checkout, git would refuse to answer, although this very code runs from it.
    git = ("git", "-C", str(checkout), "-c", f"safe.directory={checkout}")
    try:
        done = subprocess.run(  # noqa: S603  (our own words)
            (*git, "describe", "--always", "--dirty", "--abbrev=12", "--exclude=*"),
            capture_output=True,
            text=True,
            timeout=GIT_TIMEOUT_S,
            check=True,
        )
    except (OSError, subprocess.SubprocessError, UnicodeDecodeError):
        return None
    return done.stdout.strip() or None
