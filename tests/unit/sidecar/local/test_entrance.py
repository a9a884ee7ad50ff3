"""Who gets a socket of the file system: one of several sidecars, and nobody by a link."""

from __future__ import annotations

import contextlib
import grp
import multiprocessing
import os
import socket
import stat
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

from plr.sidecar.local import entrance as entrance_module
from plr.sidecar.local.client import LocalClient
from plr.sidecar.local.entrance import Entrance, SocketLock
from plr.sidecar.local.server import LocalSocketError, LocalSocketServer
from tests.unit.sidecar.local.world import NOBODY, Source

if TYPE_CHECKING:
    from multiprocessing.synchronize import Barrier, Event

pytestmark = pytest.mark.audit("ops-14")

STARTERS, ROUNDS = 4, 10


def _start(path: str, barrier: Barrier, said: Any, done: Event) -> None:
    server = LocalSocketServer(Path(path), Source())
    barrier.wait()
    try:
        server.open()
    except LocalSocketError as error:
        said.put(str(error))
    else:
        said.put("listens")
    done.wait()
    server.close()


def test_of_sidecars_that_start_at_once_one_has_the_socket(tmp_path: Path) -> None:
    path = tmp_path / "sidecar.sock"
    context = multiprocessing.get_context("fork")
    for number in range(ROUNDS):
        if number % 2:
            with socket.socket(socket.AF_UNIX) as stale:
                stale.bind(str(path))
        barrier, said, done = context.Barrier(STARTERS), context.Queue(), context.Event()
        starters = [context.Process(target=_start, args=(str(path), barrier, said, done)) for _ in range(STARTERS)]
        for starter in starters:
            starter.start()
        told = sorted(said.get(timeout=60) for _ in starters)
        try:
            assert told == [told[0]] * (STARTERS - 1) + ["listens"]
            assert "another sidecar listens there" in told[0]
            with LocalClient(path) as client:
                assert client.state()["node"] == {"name": "robot-1"}
        finally:
            done.set()
            for starter in starters:
                starter.join()
        assert not path.exists()


def test_one_that_ends_leaves_the_socket_of_its_successor(tmp_path: Path) -> None:
    path = tmp_path / "sidecar.sock"
    first = Entrance(path)
    first.open(0.0)
    path.unlink()
    second = Entrance(path)
    second.open(0.0)
    first.close()
    assert stat.S_ISSOCK(path.lstat().st_mode)
    second.close()
    assert not path.exists()


@pytest.mark.skipif(os.geteuid() != 0, reason="giving a file to a group takes root")
@pytest.mark.parametrize("what", ["link", "file", "strange socket"])
def test_nothing_else_is_opened_to_the_group_in_its_place(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, what: str
) -> None:
    """Whoever may write the folder exchanges the socket as soon as it is there."""
    victim = tmp_path / "victim"
    victim.write_text("for root's eyes")
    victim.chmod(0o600)
    path = tmp_path / "sidecar.sock"
    opening = entrance_module._open_to_group

    def exchange(path: Path, group: int | None) -> tuple[int, int]:
        path.unlink()
        if what == "link":
            path.symlink_to(victim)
        elif what == "file":
            path.hardlink_to(victim)
        else:
            with socket.socket(socket.AF_UNIX) as other:
                other.bind(str(path))
            os.chown(path, NOBODY, -1)
        return opening(path, group)

    monkeypatch.setattr(entrance_module, "_open_to_group", exchange)
    entrance = Entrance(path, grp.getgrnam("daemon").gr_gid)
    with pytest.raises(OSError, match="another program changes its folder"):
        entrance.open(0.0)
    entrance.close()
    for one in (victim, path):
        assert one.lstat().st_gid == os.getegid()
        assert stat.S_IMODE(victim.stat().st_mode) == 0o600


def test_a_folder_that_others_may_change_is_refused(tmp_path: Path) -> None:
    folder = tmp_path / "folder"
    folder.mkdir()
    folder.chmod(0o777)
    with pytest.raises(LocalSocketError, match=r"everybody may change .*folder: chmod o-w"):
        LocalSocketServer(folder / "sidecar.sock", Source()).open()
    folder.chmod(0o1777)
    server = LocalSocketServer(folder / "sidecar.sock", Source())
    server.open()
    server.close()
    if os.geteuid() == 0:
        os.chown(folder, NOBODY, -1)
        with pytest.raises(LocalSocketError, match=f"belongs to user {NOBODY}"):
            LocalSocketServer(folder / "sidecar.sock", Source()).open()


@pytest.mark.parametrize("what", ["link", "fifo"])
def test_a_lock_that_is_no_file_is_refused(tmp_path: Path, what: str) -> None:
    lock = tmp_path / "sidecar.sock.lock"
    if what == "link":
        lock.symlink_to(tmp_path / "made through a link")
    else:
        os.mkfifo(lock)
    with contextlib.closing(_Closing(SocketLock(tmp_path / "sidecar.sock"))) as taking, pytest.raises(OSError):  # noqa: PT011 - which one is the system's word
        taking.lock.take()
    assert not (tmp_path / "made through a link").exists()


class _Closing:
    def __init__(self, lock: SocketLock) -> None:
        self.lock = lock

    def close(self) -> None:
        self.lock.release()
