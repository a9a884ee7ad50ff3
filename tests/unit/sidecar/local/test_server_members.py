"""Several users at one local socket: each has a share of it, and root one that all of them together do not touch."""

from __future__ import annotations

import grp
import os
import tempfile
import time
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from plr.sidecar.local import server as server_module
from plr.sidecar.local.client import LocalBusyError, LocalClient, LocalError
from plr.sidecar.local.entrance import for_group
from plr.sidecar.local.server import MAX_OF_A_USER, MAX_OWN, LocalSocketServer
from tests.unit.sidecar.local.world import NOBODY, PATIENCE_S, Source, as_user, raw, wait_until

if TYPE_CHECKING:
    from collections.abc import Iterator

pytestmark = [
    pytest.mark.audit("ops-14"),
    pytest.mark.skipif(os.geteuid() != 0, reason="becoming another user takes root"),
]

GROUP = grp.getgrnam("daemon")
FLOOD = """
held = []
print("ready", flush=True)
while True:
    sock = socket.socket(socket.AF_UNIX)
    sock.setblocking(False)
    try:
        sock.connect({path!r})
        held.append(sock)
    except OSError:
        sock.close()
    held = held[-200:]
"""
HOLD = """
held = []
for _ in range({count}):
    sock = socket.socket(socket.AF_UNIX)
    sock.connect({path!r})
    held.append(sock)
print("ready", flush=True)
time.sleep(100)
"""
PING = """
path = pathlib.Path({path!r})
sock = socket.socket(socket.AF_UNIX)
sock.connect(path.as_posix())
asked = [dict(id=number, ask="ping", peer="cloud-1", size=64) for number in range(200)]
sock.sendall(b"".join(json.dumps(one).encode() + b"\\n" for one in asked))
print("ready", flush=True)
time.sleep(100)
"""
ASK = """
end = time.monotonic() + {patience}
while True:
    try:
        print(LocalClient(pathlib.Path({path!r})).state()["node"]["name"])
        break
    except LocalError as error:
        if time.monotonic() > end:
            raise
        time.sleep(0.1)
"""


@pytest.fixture
def source() -> Source:
    return Source()


@pytest.fixture
def folder() -> Iterator[Path]:
    """Where other users come by. Not pytest's: each session that starts closes the one of all to them."""
    with tempfile.TemporaryDirectory(prefix="plr-") as name:
        Path(name).chmod(0o755)
        yield Path(name)


@pytest.fixture
def server(folder: Path, source: Source, monkeypatch: pytest.MonkeyPatch) -> Iterator[LocalSocketServer]:
    monkeypatch.setattr(server_module, "GROUP", GROUP.gr_name)
    server = LocalSocketServer(folder / "sidecar.sock", source)
    source.server = server
    server.open()
    yield server
    server.close()
    assert not for_group(server.path).exists()


def test_a_member_who_floods_does_not_keep_root_out(server: LocalSocketServer) -> None:
    path = for_group(server.path)
    with as_user(NOBODY, [GROUP.gr_gid], FLOOD.format(path=str(path))) as flood:
        try:
            assert flood.stdout is not None
            assert flood.stdout.readline() == "ready\n"
            wait_until(lambda: server.refused["user_full"] > 50)
            for _ in range(5):
                with LocalClient(server.path) as client:
                    assert client.state()["node"] == {"name": "robot-1"}
        finally:
            flood.kill()


def test_a_member_who_holds_his_places_leaves_another_some(server: LocalSocketServer) -> None:
    script = HOLD.format(path=str(for_group(server.path)), count=2 * MAX_OF_A_USER)
    with as_user(NOBODY, [GROUP.gr_gid], script) as holder:
        try:
            assert holder.stdout is not None
            assert holder.stdout.readline() == "ready\n"
            wait_until(lambda: server.refused["user_full"] == MAX_OF_A_USER)
            script = ASK.format(path=str(server.path), patience=PATIENCE_S)
            with as_user(NOBODY - 1, [GROUP.gr_gid], script) as other:
                out, err = other.communicate(timeout=60)
            assert out == "robot-1\n", err
        finally:
            holder.kill()


def test_members_who_hold_all_their_places_leave_root_its_own(server: LocalSocketServer) -> None:
    script = HOLD.format(path=str(for_group(server.path)), count=2 * MAX_OF_A_USER)
    users = [as_user(NOBODY - number, [GROUP.gr_gid], script) for number in range(5)]
    try:
        for user in users:
            assert user.stdout is not None
            assert user.stdout.readline() == "ready\n"
        wait_until(lambda: server.refused["full"] > 0)
        assert all(sum(one.user == NOBODY - n for one in server._clients.values()) <= MAX_OF_A_USER for n in range(5))
        with LocalClient(server.path) as client:
            assert client.state()["node"] == {"name": "robot-1"}
        with as_user(NOBODY - 9, [GROUP.gr_gid], ASK.format(path=str(server.path), patience=0)) as late:
            assert "LocalBusyError: too many clients ask at once: try again" in late.communicate(timeout=60)[1]
    finally:
        for user in users:
            user.kill()
            user.communicate()


def test_a_member_who_pings_without_end_leaves_root_its_pings(server: LocalSocketServer) -> None:
    with as_user(NOBODY, [GROUP.gr_gid], PING.format(path=str(for_group(server.path)))) as greedy:
        try:
            assert greedy.stdout is not None
            assert greedy.stdout.readline() == "ready\n"
            wait_until(lambda: server.refused["too_often"] >= 3)
            with LocalClient(server.path) as client:
                for _ in range(20):
                    client.ping("cloud-1", "wlan0", 64)
                    said = [client.next_line(PATIENCE_S) for _ in range(3)]
                    assert [(line or {}).get("part") for line in said] == ["pinged", "pong", None]
                    assert said[1] is not None
                    assert said[1]["value"]["problem"] == ""
        finally:
            greedy.kill()


def test_a_full_house_is_called_busy(server: LocalSocketServer) -> None:
    socks = [raw(server) for _ in range(MAX_OWN)]
    wait_until(lambda: len(server._clients) == MAX_OWN)
    with pytest.raises(LocalBusyError, match="too many clients ask at once"), LocalClient(server.path) as client:
        client.state()
    for sock in socks:
        sock.close()


def test_a_queue_that_is_full_is_called_busy(server: LocalSocketServer, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("plr.sidecar.local.client.CONNECT_S", 1)
    server._stopping = True
    server._ring()
    server._thread.join()
    socks = []
    while True:
        try:
            socks.append(raw(server, patience_s=0.0))
        except BlockingIOError:
            break
    began = time.monotonic()
    with pytest.raises(LocalBusyError, match="busy with others"):
        LocalClient(server.path)
    assert time.monotonic() - began >= 0.9
    for sock in socks:
        sock.close()


def test_a_stranger_s_socket_is_not_asked(folder: Path) -> None:
    path = folder / "sub"
    path.mkdir()
    os.chown(path, NOBODY, NOBODY)
    script = f"""
sock = socket.socket(socket.AF_UNIX)
sock.bind({str(path / "s")!r})
sock.listen()
print("ready", flush=True)
time.sleep(100)
"""
    with as_user(NOBODY, [], script) as stranger:
        try:
            assert stranger.stdout is not None
            assert stranger.stdout.readline() == "ready\n"
            with pytest.raises(LocalError, match=f"user {NOBODY} listens there and is neither root nor plr"):
                LocalClient(path / "s")
            LocalClient(path / "s", frozenset({NOBODY})).close()
        finally:
            stranger.kill()
