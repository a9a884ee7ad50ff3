"""Opens regular files without ever blocking: a FIFO or a device in their place is refused."""

from __future__ import annotations

import errno
import os
import stat
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pathlib import Path
    from typing import BinaryIO


def open_regular(path: Path, *, folder: int | None = None) -> BinaryIO:
    """Open a file for reading; raise OSError, also if it is not a regular file or nothing can have such a name.

    `folder` is the descriptor of the folder that a relative path starts from.
    """
    try:
        # Without O_NONBLOCK, opening a FIFO would block until somebody writes to it.
        descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC, dir_fd=folder)
    except ValueError as error:
        raise OSError(errno.EINVAL, "its name contains a NUL") from error
    refuse_irregular(descriptor)
    return open(descriptor, "rb")


def read_regular(path: Path, most: int) -> bytes:
    """Return the first `most` bytes of a file; raises OSError like `open_regular`."""
    with open_regular(path) as file:
        return file.read(most)


def refuse_irregular(descriptor: int) -> None:
    """Close a descriptor of anything but a regular file, and raise OSError."""
    mode = os.fstat(descriptor).st_mode
    if not stat.S_ISREG(mode):
        os.close(descriptor)
        raise OSError(errno.EISDIR, os.strerror(errno.EISDIR)) if stat.S_ISDIR(mode) else _no_file()


def _no_file() -> OSError:
    return OSError(errno.EINVAL, "it is not a regular file")
