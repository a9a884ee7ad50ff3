"""Which commit this is: written down when a wheel is built, asked of git in a checkout."""

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
    """Return the commit, with -dirty if files differ from it; None if nobody knows. Asks git in a checkout."""
    folder = Path(__file__).resolve().parent
    try:
        return (folder / STAMP).read_text().strip() or None
    except (OSError, UnicodeDecodeError):
        return _asked_of_git(folder.parents[1])


def version() -> str:
    """Return the version of the installed distribution and the commit; what is not known is left out."""
    try:
        release = metadata.version(DISTRIBUTION)
    except metadata.PackageNotFoundError:
        release = "from source"
    made_of = commit()
    return f"{release}+{made_of}" if made_of is not None else release


def _asked_of_git(checkout: Path) -> str | None:
    # An environment may stand inside another project's checkout, whose commit is not ours.
    if not (checkout / ".git").exists():
        return None
    # Root runs a checkout that is somebody else's: git would say nothing, though this very code is run from it.
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
