"""Opens what is a file, and waits for nobody: a FIFO or a device in its place is refused."""

from __future__ import annotations

import errno
import os
import stat
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pathlib import Path
    from typing import BinaryIO


def open_regular(path: Path) -> BinaryIO:
    """Open a file to read it; raises OSError, also if it is none, or nothing can have such a name."""
    try:
        # A FIFO would be waited for until somebody writes to it.
        descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    except ValueError as error:
        raise OSError(errno.EINVAL, "there is a NUL in its name") from error
    mode = os.fstat(descriptor).st_mode
    if not stat.S_ISREG(mode):
        os.close(descriptor)
        raise OSError(errno.EISDIR, os.strerror(errno.EISDIR)) if stat.S_ISDIR(mode) else _no_file()
    return open(descriptor, "rb")


def _no_file() -> OSError:
    return OSError(errno.EINVAL, "it is no regular file")
