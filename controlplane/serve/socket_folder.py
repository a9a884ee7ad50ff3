"""Makes the folder of the sockets behind the gate, and removes those that killed control planes left behind.

A folder is in use while somebody holds a lock on it, and the kernel releases the lock of a process that ends in any
way. systemd-tmpfiles leaves a locked folder alone too. A folder of a version that took no lock is in use while one of
its sockets accepts.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import re
import shutil
import socket
import stat
import tempfile
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterator

PREFIX = "plr-controlplane-"
MAX_LOOKED_AT = 10_000
"""Entries of the folder for temporary files that are looked at: other users may fill it."""
_SOCKET = re.compile(r"grpc-\d+")
_DIRECTORY = os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC


def socket_path(folder: str, number: int) -> str:
    """Return the path of the socket of a gRPC server."""
    return f"{folder}/grpc-{number}"


@contextlib.contextmanager
def socket_folder() -> Iterator[str]:
    """Yield the path of a new folder that only this user can enter, and remove it at the end.

    Raises:
        OSError: the folder for temporary files cannot be used.
    """
    remove_abandoned(Path(tempfile.gettempdir()))
    folder, held = _make()
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)
        os.close(held)


def _make() -> tuple[str, int]:
    while True:
        folder = tempfile.mkdtemp(prefix=PREFIX)
        try:
            held = os.open(folder, _DIRECTORY)
        except FileNotFoundError:
            continue  # another control plane that starts now took it for an abandoned one
        with contextlib.suppress(BlockingIOError, FileNotFoundError):
            fcntl.flock(held, fcntl.LOCK_EX | fcntl.LOCK_NB)
            os.stat(folder)
            return folder, held
        os.close(held)


def remove_abandoned(parent: Path) -> int:
    """Remove the folders of this user's control planes that do not run any more; return their number.

    It follows no symbolic link, and removes nothing but sockets: a folder with other content stays.
    """
    removed = 0
    with contextlib.suppress(OSError), os.scandir(parent) as entries:
        for entry in islice(entries, MAX_LOOKED_AT):
            if entry.name.startswith(PREFIX):
                with contextlib.suppress(OSError):
                    removed += _remove_if_abandoned(entry.path)
    return removed


def _remove_if_abandoned(path: str) -> bool:
    folder = os.open(path, _DIRECTORY)
    try:
        status = os.fstat(folder)
        if status.st_uid != os.geteuid() or stat.S_IMODE(status.st_mode) != stat.S_IRWXU:
            return False
        fcntl.flock(folder, fcntl.LOCK_EX | fcntl.LOCK_NB)  # raises BlockingIOError while it is in use
        sockets = [name for name in os.listdir(folder) if _SOCKET.fullmatch(name) and _is_socket(folder, name)]
        if any(_accepts(f"/proc/self/fd/{folder}/{name}") for name in sockets):
            return False
        for name in sockets:
            os.unlink(name, dir_fd=folder)
        os.rmdir(path)
        return True
    finally:
        os.close(folder)


def _is_socket(folder: int, name: str) -> bool:
    return stat.S_ISSOCK(os.stat(name, dir_fd=folder, follow_symlinks=False).st_mode)


def _accepts(path: str) -> bool:
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as client:
        client.setblocking(False)
        try:
            client.connect(path)
        except ConnectionRefusedError:
            return False
        except OSError:
            return True  # its queue is full, for example
    return True
