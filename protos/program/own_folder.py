"""Opens a program's own folder by descriptor, so that nothing others put beside it or in its place has any effect.

Under a path in a folder such as /tmp, another user may have made the folder before, or one above it, with links to
files that only we may write. So the path is walked step by step, each step is judged by what was opened, and links in
the folder are never followed.
"""

from __future__ import annotations

import contextlib
import errno
import os
import stat
from pathlib import Path
from typing import IO, TYPE_CHECKING

from plr.protos.program.regular_file import refuse_irregular

if TYPE_CHECKING:
    from collections.abc import Container
    from typing import BinaryIO

ASIDE_SUFFIX = ".new"
_MAX_LINKS = 8


def refuse_strange(folder: Path, status: os.stat_result, trusted: Container[int] | None = None) -> None:
    """Raise OSError if others could replace what is in a folder; in one such as /tmp they can only add to it.

    `trusted` holds the users who may own it, by default root and this user.
    """
    if status.st_uid not in (trusted or (0, os.geteuid())):
        raise OSError(errno.EPERM, f"{folder} belongs to user {status.st_uid}: chown it, or name a folder of its own")
    if status.st_mode & stat.S_IWOTH and not status.st_mode & stat.S_ISVTX:
        raise OSError(errno.EPERM, f"everybody may change {folder}: chmod o-w, or name a folder of its own")


class OwnFolder:
    """A folder that belongs to root or this user, created (0700) if it does not exist; all methods raise OSError.

    The folders above it are judged like it, and created as by `mkdir -p`. Any of them may be a link that root or this
    user made, such as /var/run or those of systemd.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._descriptor = _open_folder(path)
        try:
            refuse_strange(path, os.fstat(self._descriptor))
        except OSError:
            self.close()
            raise

    def close(self) -> None:
        """Release the folder."""
        os.close(self._descriptor)

    def open_itself(self) -> int:
        """Return a descriptor of the folder itself, for a lock where no file can be created."""
        return os.open(".", os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC, dir_fd=self._descriptor)

    def open(self, name: str, flags: int) -> int:
        """Return a descriptor of a file in it, 0600 if `flags` create it; a link, or another user's, is refused."""
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
            # A file of an earlier version may be readable, and so lockable, for everybody.
            with contextlib.suppress(OSError):
                os.fchmod(descriptor, 0o600)
        return descriptor

    def open_to_read(self, name: str) -> BinaryIO:
        """Open a file in it to read it."""
        return open(self.open(name, os.O_RDONLY), "rb")

    def write(self, name: str, data: bytes) -> None:
        """Replace a file in it as a whole: a power cut leaves either the old or the new one."""
        aside = name + ASIDE_SUFFIX
        self._remove(aside)
        try:
            with open(self.open(aside, os.O_WRONLY | os.O_CREAT | os.O_EXCL), "wb", buffering=0) as file:
                write_through(file, data)
            self.rename(aside, name)
        except OSError:
            # Half a file takes up room on a full disk.
            with contextlib.suppress(OSError):
                self._remove(aside)
            raise
        os.fsync(self._descriptor)

    def rename(self, old: str, new: str) -> None:
        """Rename a file within the folder."""
        os.replace(old, new, src_dir_fd=self._descriptor, dst_dir_fd=self._descriptor)

    def _remove(self, name: str) -> None:
        with contextlib.suppress(FileNotFoundError):
            os.unlink(name, dir_fd=self._descriptor)


def write_through(file: IO[bytes], data: bytes) -> None:
    """Write to an unbuffered file and wait until the data is on disk; raises OSError."""
    view = memoryview(data)
    while view:
        view = view[file.write(view) :]
    os.fdatasync(file.fileno())


def _open_folder(path: Path) -> int:
    """Return a descriptor of the folder; check the owners on the way, as any could lead us elsewhere."""
    # In a user namespace, root's own folders, such as /, belong to a user without a number there.
    trusted = {0, os.geteuid(), os.stat("/").st_uid}
    names = [*reversed(path.absolute().parts)]
    way, here, links = Path("/"), -1, 0
    try:
        while names:
            name = names.pop()
            way /= name
            last = not names
            there = _step(here, name, 0o700 if last else 0o777)
            status = os.fstat(there)
            if stat.S_ISLNK(status.st_mode):
                target = _target(way, there, status, trusted)
                links += 1
                if links > _MAX_LINKS:
                    raise OSError(errno.ELOOP, os.strerror(errno.ELOOP), str(path))
                names += reversed(target.parts)
                way = way.parent
                continue
            if here >= 0:
                os.close(here)
            here = there
            if not last:
                refuse_strange(way, status, trusted)
        return os.open(".", os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC, dir_fd=here)
    finally:
        if here >= 0:
            os.close(here)


def _step(here: int, name: str, mode: int) -> int:
    """Return a descriptor of the entry of this name in a folder; if there is none, create a folder."""
    flags = os.O_PATH | os.O_NOFOLLOW | os.O_CLOEXEC
    if name.startswith("/"):
        return os.open("/", flags)
    try:
        return os.open(name, flags, dir_fd=here)
    except FileNotFoundError:
        with contextlib.suppress(FileExistsError):
            os.mkdir(name, mode, dir_fd=here)
        return os.open(name, flags, dir_fd=here)


def _target(way: Path, link: int, status: os.stat_result, trusted: Container[int]) -> Path:
    """Return where a link leads, and close it."""
    try:
        if status.st_uid not in trusted:
            raise OSError(
                errno.EPERM, f"{way} is a link of user {status.st_uid}: remove it, or name a folder of its own"
            )
        return Path(os.readlink("", dir_fd=link))
    finally:
        os.close(link)
