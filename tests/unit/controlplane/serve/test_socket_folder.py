"""Tests which folders of sockets a starting control plane removes: those of dead ones, and nothing else."""

from __future__ import annotations

import fcntl
import os
import signal
import socket
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

from plr.controlplane.serve.socket_folder import PREFIX, remove_abandoned, socket_folder, socket_path

CHILD = """
import socket, sys, time
from plr.controlplane.serve.socket_folder import socket_folder, socket_path
with socket_folder() as folder:
    server = socket.socket(socket.AF_UNIX)
    server.bind(socket_path(folder, 0))
    server.listen()
    print(folder, flush=True)
    time.sleep(60)
"""


@pytest.fixture
def tmp_path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Short, since the path of a socket has at most 107 bytes."""
    return tmp_path_factory.mktemp("s")


@pytest.fixture(autouse=True)
def own_tmp(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    monkeypatch.setenv("TMPDIR", str(tmp_path))


def listening(path: str) -> socket.socket:
    server = socket.socket(socket.AF_UNIX)
    server.bind(path)
    server.listen()
    return server


def dead_folder(parent: Path, name: str = "dead") -> Path:
    folder = parent / f"{PREFIX}{name}"
    folder.mkdir(mode=0o700)
    for number in range(2):
        listening(socket_path(str(folder), number)).close()
    return folder


def test_the_folder_of_a_killed_control_plane_goes_at_the_next_start(tmp_path: Path) -> None:
    child = subprocess.Popen([sys.executable, "-c", CHILD], stdout=subprocess.PIPE, text=True)
    assert child.stdout is not None
    folder = Path(child.stdout.readline().strip())
    with socket_folder():
        assert folder.is_dir()  # it still runs
    child.send_signal(signal.SIGKILL)
    child.wait()
    child.stdout.close()
    assert folder.is_dir()
    with socket_folder() as own:
        assert not folder.exists()
        assert os.stat(own).st_mode & 0o777 == 0o700
    assert list(tmp_path.iterdir()) == []


def test_a_folder_without_a_lock_stays_while_its_socket_accepts(tmp_path: Path) -> None:
    folder = tmp_path / f"{PREFIX}earlier-version"
    folder.mkdir(mode=0o700)
    with listening(socket_path(str(folder), 3)):
        assert remove_abandoned(tmp_path) == 0
    assert remove_abandoned(tmp_path) == 1


def test_nothing_but_sockets_is_removed(tmp_path: Path) -> None:
    folder = dead_folder(tmp_path)
    (folder / "keys").touch()
    (folder / "grpc-7").touch()
    assert remove_abandoned(tmp_path) == 0
    assert sorted(path.name for path in folder.iterdir()) == ["grpc-7", "keys"]


def test_symbolic_links_are_not_followed(tmp_path: Path) -> None:
    victim = dead_folder(tmp_path).rename(tmp_path / "victim")
    (tmp_path / f"{PREFIX}link").symlink_to(victim)
    folder = tmp_path / f"{PREFIX}with-a-link"
    folder.mkdir(mode=0o700)
    (folder / "grpc-0").symlink_to(victim / "grpc-0")
    assert remove_abandoned(tmp_path) == 0
    assert (victim / "grpc-0").is_socket()


@pytest.mark.parametrize("mode", [0o755, 0o777])
def test_a_folder_that_others_may_enter_is_not_ours(tmp_path: Path, mode: int) -> None:
    folder = dead_folder(tmp_path)
    folder.chmod(mode)
    assert remove_abandoned(tmp_path) == 0
    assert len(list(folder.iterdir())) == 2


def test_a_folder_of_another_user_stays(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    dead_folder(tmp_path)
    monkeypatch.setattr(os, "geteuid", lambda: os.getuid() + 1)
    assert remove_abandoned(tmp_path) == 0


@pytest.mark.parametrize("when", ["it holds the lock", "it is done"])
def test_a_folder_that_another_start_takes_for_abandoned_is_made_again(
    when: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    make, made, held = tempfile.mkdtemp, list[str](), list[int]()

    def take_first(*, prefix: str) -> str:
        made.append(make(prefix=prefix))
        if len(made) == 1:
            held.append(os.open(made[0], os.O_RDONLY))
            fcntl.flock(held[0], fcntl.LOCK_EX)
            if when == "it is done":
                os.rmdir(made[0])
        return made[-1]

    monkeypatch.setattr(tempfile, "mkdtemp", take_first)
    with socket_folder() as folder:
        assert folder == made[1]
        assert Path(folder).is_dir()
    os.close(held[0])
