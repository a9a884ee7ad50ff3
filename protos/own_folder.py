"""A folder of a program's own, by descriptor: what others put beside or in place of it leads nowhere.

Under a path in a folder such as /tmp somebody else may have made the folder before, with links to files that he may not
write but we may. So a folder is opened once and judged by what was opened, and names in it are never followed.
"""

from __future__ import annotations

import contextlib
import errno
import os
import stat
from typing import IO, TYPE_CHECKING

from protos.regular_file import refuse_irregular

if TYPE_CHECKING:
    from pathlib import Path
    from typing import BinaryIO

ASIDE_SUFFIX = ".new"
_MAX_LINKS = 8


def refuse_strange(folder: Path, status: os.stat_result) -> None:
    """Raise OSError if others could exchange what is in a folder; in one such as /tmp they can only add to it."""
    if status.st_uid not in (0, os.geteuid()):
        raise OSError(errno.EPERM, f"{folder} belongs to user {status.st_uid}: chown it, or name a folder of its own")
    if status.st_mode & stat.S_IWOTH and not status.st_mode & stat.S_ISVTX:
        raise OSError(errno.EPERM, f"everybody may change {folder}: chmod o-w, or name a folder of its own")


class OwnFolder:
    """A folder that belongs to root or this user, made (0700) if it is not there; all methods raise OSError.

    `path` may be a link that root or this user made, as systemd does.
    """

    def __init__(self, path: Path) -> None:
        path.mkdir(mode=0o700, parents=True, exist_ok=True)
        self.path = path
        self._descriptor = _open_folder(path)
        try:
            refuse_strange(path, os.fstat(self._descriptor))
        except OSError:
            self.close()
            raise

    def close(self) -> None:
        """Let it go."""
        os.close(self._descriptor)

    def open(self, name: str, flags: int) -> int:
        """Return a descriptor of a file in it, 0600 where `flags` create it; a link, or another user's, is refused."""
        try:
            flags |= os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC
            descriptor = os.open(name, flags, 0o600, dir_fd=self._descriptor)
        except OSError as error:
            if error.errno == errno.ELOOP:
                raise OSError(errno.ELOOP, f"{name} is a link: remove it") from error
            raise
        refuse_irregular(descriptor)
        owner = os.fstat(descriptor).st_uid
        if owner not in (0, os.geteuid()):
            os.close(descriptor)
            raise OSError(errno.EPERM, f"{name} belongs to user {owner}: chown or remove it")
        if flags & os.O_CREAT and owner == os.geteuid():
            # One of an earlier version may be for everybody to read, and so to lock.
            with contextlib.suppress(OSError):
                os.fchmod(descriptor, 0o600)
        return descriptor

    def open_to_read(self, name: str) -> BinaryIO:
        """Open a file in it to read it."""
        return open(self.open(name, os.O_RDONLY), "rb")

    def write(self, name: str, data: bytes) -> None:
        """Replace a file in it as a whole: a power cut leaves the old one or the new one."""
        aside = name + ASIDE_SUFFIX
        self._remove(aside)
        try:
            with open(self.open(aside, os.O_WRONLY | os.O_CREAT | os.O_EXCL), "wb", buffering=0) as file:
                write_through(file, data)
            self.rename(aside, name)
        except OSError:
            # Half a file takes room on a disk that is full.
            with contextlib.suppress(OSError):
                self._remove(aside)
            raise
        os.fsync(self._descriptor)

    def rename(self, old: str, new: str) -> None:
        """Give a file in it another name in it."""
        os.replace(old, new, src_dir_fd=self._descriptor, dst_dir_fd=self._descriptor)

    def _remove(self, name: str) -> None:
        with contextlib.suppress(FileNotFoundError):
            os.unlink(name, dir_fd=self._descriptor)


def write_through(file: IO[bytes], data: bytes) -> None:
    """Write to an unbuffered file, and wait until the disk has it; raises OSError."""
    view = memoryview(data)
    while view:
        view = view[file.write(view) :]
    os.fdatasync(file.fileno())


def _open_folder(path: Path) -> int:
    flags = os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC
    for _ in range(_MAX_LINKS):
        try:
            return os.open(path, flags)
        except OSError as error:
            if error.errno not in (errno.ELOOP, errno.ENOTDIR):
                raise
            link = os.open(path, os.O_PATH | os.O_NOFOLLOW | os.O_CLOEXEC)
            try:
                status = os.fstat(link)
                if not stat.S_ISLNK(status.st_mode):
                    raise
                if status.st_uid not in (0, os.geteuid()):
                    text = f"{path} is a link of user {status.st_uid}: remove it, or name a folder of its own"
                    raise OSError(errno.EPERM, text) from error
                path = path.parent / os.readlink("", dir_fd=link)
            finally:
                os.close(link)
    raise OSError(errno.ELOOP, os.strerror(errno.ELOOP))
