"""Opens listening sockets in the file system: one for root and the sidecar's user, one for the members of a group.

There are two because the kernel queues everybody who connects before it tells who they are: in a queue of their own,
members cannot keep root out. The holder of the lock file beside them has both.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import socket
import stat
from pathlib import Path
from typing import TYPE_CHECKING

from plr.protos.program.own_folder import refuse_strange
from plr.sidecar.local.shares import Rate

if TYPE_CHECKING:
    from plr.protos.base.token_bucket import TokenBucket

GROUP_SUFFIX = ".group"
LOCK_SUFFIX = ".lock"
MAX_SOCKET_BYTES = 107
"""Longest path of a unix socket (unix(7))."""
BACKLOG = 64
"""Most connections that wait in the kernel to be accepted."""
ACCEPTS = Rate(per_s=200.0, at_once=64.0)
"""Rate through one entrance. A connection that is dropped at once takes some 50 µs: a flood costs a hundredth of a
core."""
ACCEPT_PAUSE_S = 0.05


def for_group(path: Path) -> Path:
    """Return the socket's path for the members of the group; `path` is for root and the sidecar's user."""
    return Path(f"{path}{GROUP_SUFFIX}")


class SocketLock:
    """Keeps a second sidecar from the sockets at `path`, from `take` to `release`. Its file stays, so that no other
    file ever gets its name."""

    def __init__(self, path: Path) -> None:
        self._path = Path(f"{path}{LOCK_SUFFIX}")
        self._descriptor: int | None = None

    def take(self) -> None:
        """Take the lock. Raises OSError if another sidecar has it, or if others could exchange files in its folder."""
        refuse_strange(self._path.parent, self._path.parent.stat())
        flags = os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC
        descriptor = os.open(self._path, flags, 0o600)
        try:
            if not stat.S_ISREG(os.fstat(descriptor).st_mode):
                raise OSError(errno.EEXIST, f"{self._path.name} is not a regular file")
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            os.close(descriptor)
            raise _taken() from None
        except OSError:
            os.close(descriptor)
            raise
        self._descriptor = descriptor

    def release(self) -> None:
        """Release the lock to another sidecar."""
        if self._descriptor is not None:
            os.close(self._descriptor)
            self._descriptor = None


class Entrance:
    """A listening socket at `path`, with mode 0600, or 0660 for `group`; its SocketLock is held from `open` to `close`.

    Times are monotonic seconds.
    """

    def __init__(self, path: Path, group: int | None = None) -> None:
        self.path = path
        self.group = group
        self.sock: socket.socket | None = None
        """Non-blocking."""
        self.again_at: float | None = None
        """When to accept again; None: at once."""
        self._accepts: TokenBucket | None = None
        self._node: tuple[int, int] | None = None

    def open(self, now: float) -> None:
        """Start to listen; raises OSError."""
        if len(os.fsencode(self.path)) > MAX_SOCKET_BYTES:
            raise OSError(errno.ENAMETOOLONG, f"the path of a socket has at most {MAX_SOCKET_BYTES} bytes")
        _remove_stale(self.path)
        sock = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM | socket.SOCK_NONBLOCK | socket.SOCK_CLOEXEC)
        try:
            # The file system node gets this mode: nobody else gets in before its group is set.
            os.fchmod(sock.fileno(), stat.S_IRUSR | stat.S_IWUSR)
            sock.bind(str(self.path))
            self._node = _open_to_group(self.path, self.group)
            sock.listen(BACKLOG)
        except OSError:
            sock.close()
            raise
        self.sock = sock
        self._accepts = ACCEPTS.bucket(now)

    def accept(self, now: float) -> socket.socket | None:
        """Return a non-blocking connection; None if none waits, or it is too early (`again_at`)."""
        if self.sock is None or self._accepts is None:
            return None
        if not self._accepts.take(now):
            self.again_at = now + ACCEPT_PAUSE_S
            return None
        try:
            sock, _ = self.sock.accept()
        except OSError:
            return None
        sock.setblocking(False)
        return sock

    def close(self) -> None:
        """Stop listening, and remove the socket unless another one has taken its place."""
        if self.sock is None:
            return
        with contextlib.suppress(OSError):
            status = self.path.lstat()
            if (status.st_dev, status.st_ino) == self._node:
                self.path.unlink()
        self.sock.close()
        self.sock = None


def _remove_stale(path: Path) -> None:
    """Remove a socket that nobody listens at: a killed run left it behind."""
    try:
        if not stat.S_ISSOCK(path.lstat().st_mode):
            raise OSError(errno.EEXIST, "something other than a socket is there")
    except FileNotFoundError:
        return
    # The lock only shows sidecars that use it; the socket may be another program's, or an earlier version's.
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM | socket.SOCK_NONBLOCK) as probe:
        answer = probe.connect_ex(str(path))
    if answer == errno.ECONNREFUSED:
        path.unlink(missing_ok=True)
    elif answer != errno.ENOENT:
        raise _taken()


def _open_to_group(path: Path, group: int | None) -> tuple[int, int]:
    """Let the group connect to the socket just bound at `path`; return its device and inode."""
    # By descriptor: a moment later the name may be a link to any file of ours.
    descriptor = os.open(path, os.O_PATH | os.O_NOFOLLOW | os.O_CLOEXEC)
    try:
        status = os.fstat(descriptor)
        if not stat.S_ISSOCK(status.st_mode) or status.st_uid != os.geteuid():
            raise OSError(errno.EPERM, "another program changes its folder")
        if group is not None:
            itself = f"/proc/self/fd/{descriptor}"
            if status.st_gid != group:
                os.chown(itself, -1, group)
            os.chmod(itself, stat.S_IRUSR | stat.S_IWUSR | stat.S_IRGRP | stat.S_IWGRP)
        return status.st_dev, status.st_ino
    finally:
        os.close(descriptor)


def _taken() -> OSError:
    return OSError(errno.EADDRINUSE, "another sidecar listens there: set local_socket in one of them")
