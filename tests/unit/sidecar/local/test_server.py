"""The local socket with real clients: what is answered, who is let in, and what hostile ones cost."""

from __future__ import annotations

import contextlib
import grp
import json
import os
import socket
import stat
import subprocess
import sys
import time
from typing import TYPE_CHECKING, Any

import pytest

from plr.sidecar.local import server as server_module
from plr.sidecar.local.client import LocalClient, LocalError
from plr.sidecar.local.entrance import for_group
from plr.sidecar.local.server import MAX_OWN, MAX_REQUESTED_PINGS, STATES, LocalSocketError, LocalSocketServer
from tests.unit.sidecar.local.world import NOBODY, PATIENCE_S, ROOT, Source, raw, reachable, wait_until

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

pytestmark = pytest.mark.audit("ops-14")


@pytest.fixture
def source() -> Source:
    return Source()


@pytest.fixture
def server(tmp_path: Path, source: Source) -> Iterator[LocalSocketServer]:
    server = LocalSocketServer(tmp_path / "sidecar.sock", source)
    source.server = server
    server.open()
    yield server
    server.close()
    assert not server._thread.is_alive()
    assert not server.path.exists()


def test_the_state_comes_in_parts(server: LocalSocketServer, source: Source) -> None:
    source.parts = 500
    with LocalClient(server.path) as client:
        state = client.state()
    assert state["node"] == {"name": "robot-1"}
    assert [path["remote"] for path in state["paths"]] == list(range(500))
    assert source.threads == {"plr-local"}


def test_a_ping_is_answered_path_by_path(server: LocalSocketServer) -> None:
    with LocalClient(server.path) as client:
        mine = client.ping("cloud-1", None, 64)
        lines = []
        while True:
            line = client.next_line(PATIENCE_S)
            assert line is not None
            assert line["id"] == mine
            if line.get("end"):
                break
            lines.append(line)
    assert [line["part"] for line in lines] == ["pinged", "pong", "pong"]
    assert {line["value"]["interface"] for line in lines[1:]} == {"wlan0", "wwan0"}
    assert {line["value"]["rtt_s"] for line in lines[1:]} == {0.012}


def test_a_ping_to_nobody_is_an_error(server: LocalSocketServer) -> None:
    with LocalClient(server.path) as client:
        client.ping("cloud-9", None, 64)
        line = client.next_line(PATIENCE_S)
        assert line is not None
        assert "no path to cloud-9" in line["error"]


def test_only_owner_root_and_group_may_open_it(server: LocalSocketServer) -> None:
    assert stat.S_IMODE(server.path.stat().st_mode) == 0o600
    assert for_group(server.path).exists() is (server._group is not None)


@pytest.mark.skipif(os.geteuid() != 0, reason="becoming another user takes root")
def test_another_user_is_refused_even_where_the_socket_is_open_to_all(server: LocalSocketServer) -> None:
    for folder in reachable(server.path.parent):
        folder.chmod(0o755)
    script = f"""
import os, socket
os.setgroups([]); os.setgid({NOBODY}); os.setuid({NOBODY})
with socket.socket(socket.AF_UNIX) as sock:
    try:
        sock.connect({str(server.path)!r})
        print(sock.recv(1000).decode())
    except PermissionError:
        print("permission denied")
"""
    asked = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=60)
    assert asked.stdout == "permission denied\n", asked.stderr
    server.path.chmod(0o666)
    asked = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=60)
    assert "only root and members of the group plr may ask" in asked.stdout, asked.stderr
    assert server.refused["not_allowed"] == 1


@pytest.mark.skipif(os.geteuid() != 0, reason="becoming another user takes root")
def test_a_member_of_the_group_may_ask_and_others_may_not(
    tmp_path: Path, source: Source, monkeypatch: pytest.MonkeyPatch
) -> None:
    group = grp.getgrnam("daemon")
    monkeypatch.setattr(server_module, "GROUP", group.gr_name)
    for folder in reachable(tmp_path):
        folder.chmod(0o755)
    server = LocalSocketServer(tmp_path / "sidecar.sock", source)
    server.open()
    try:
        status = for_group(server.path).stat()
        assert (stat.S_IMODE(status.st_mode), status.st_gid) == (0o660, group.gr_gid)
        for groups, allowed in (([group.gr_gid], True), ([], False)):
            script = f"""
import os, sys, pathlib
from plr.sidecar.local.client import LocalClient, LocalError
os.setgroups({groups}); os.setgid({NOBODY}); os.setuid({NOBODY})
try:
    print(LocalClient(pathlib.Path({str(server.path)!r})).state()["node"]["name"])
except LocalError as error:
    print(error)
"""
            asked = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=60, cwd=ROOT)
            assert ("robot-1" in asked.stdout) is allowed, asked.stderr
            assert ("this user may not ask the sidecar" in asked.stdout) is not allowed
    finally:
        server.close()


@pytest.mark.parametrize(
    "garbage",
    [b"\n", b"hello\n", b"{}\n", b"[1]\n", b'{"id":1}\n', b'{"id":-1,"ask":"state"}\n', b'{"id":true,"ask":"state"}\n',
     b'{"id":1,"ask":"ping","peer":"../x","size":64}\n', b'{"id":1,"ask":"ping","peer":"a","size":1e9}\n',
     b'{"id":1,"ask":"ping","peer":"a","size":64,"interface":"' + b"x" * 99 + b'"}\n',
     b"[" * 900 + b"\n", b"x" * 100_000, bytes(range(256)) + b"\n", b"\xff\xfe\n"],
)  # fmt: skip
def test_garbage_ends_its_connection_and_no_other(server: LocalSocketServer, garbage: bytes) -> None:
    with LocalClient(server.path) as good, raw(server) as bad:
        with contextlib.suppress(BrokenPipeError, ConnectionResetError):
            bad.sendall(garbage)
        answer = b""
        with contextlib.suppress(ConnectionResetError):
            while data := bad.recv(4096):
                answer += data
        assert b"error" in answer or len(garbage) > 4096
        assert good.state()["node"] == {"name": "robot-1"}
    assert server.refused["bad_request"] == 1


def test_half_a_request_is_not_waited_for_long(server: LocalSocketServer, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(server_module, "PATIENCE_S", 0.2)
    monkeypatch.setattr(server_module, "LOOK_S", 0.05)
    with raw(server) as half:
        half.sendall(b'{"id":1,')
        assert half.recv(100) == b""
    assert server.refused["too_slow"] == 1


def test_who_says_nothing_is_let_go(server: LocalSocketServer, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(server_module, "IDLE_S", 0.2)
    monkeypatch.setattr(server_module, "LOOK_S", 0.05)
    with raw(server) as silent:
        assert silent.recv(100) == b""


def test_who_does_not_read_costs_a_buffer_and_is_let_go(
    server: LocalSocketServer, source: Source, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(server_module, "PATIENCE_S", 0.5)
    monkeypatch.setattr(server_module, "LOOK_S", 0.05)
    monkeypatch.setattr(server_module, "PAUSE_S", 0.0)
    source.parts = 100_000
    with raw(server) as stuck:
        stuck.sendall(b'{"id":1,"ask":"state"}\n')
        wait_until(lambda: server.refused["too_slow"] == 1)
        assert not server._clients
    with LocalClient(server.path) as client:
        source.parts = 1
        assert client.state()["node"]


def test_of_a_thousand_connections_few_are_taken_and_none_stays(server: LocalSocketServer) -> None:
    socks: list[socket.socket] = []
    try:
        for _ in range(1000):
            sock = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
            sock.setblocking(False)
            with contextlib.suppress(BlockingIOError):
                sock.connect(str(server.path))
            socks.append(sock)
        wait_until(lambda: len(server._clients) == MAX_OWN)
    finally:
        for sock in socks:
            sock.close()
    wait_until(lambda: not server._clients)
    end = time.monotonic() + PATIENCE_S
    while True:
        try:
            with LocalClient(server.path) as client:
                assert client.state()["node"]
                break
        except LocalError:
            assert time.monotonic() < end
            time.sleep(0.1)


@pytest.mark.parametrize("end", [b"\n", b""])
@pytest.mark.parametrize("ask", ["state", "ping"])
def test_who_has_nothing_more_to_ask_is_answered_all_the_same(
    server: LocalSocketServer, source: Source, ask: str, end: bytes
) -> None:
    """As `echo ... | nc -N -U` and socat do."""
    source.parts = 300
    with raw(server) as half:
        half.sendall(json.dumps({"id": 7, "ask": ask, "peer": "cloud-1", "size": 64}).encode() + end)
        half.shutdown(socket.SHUT_WR)
        answer = b""
        while data := half.recv(65_536):
            answer += data
    lines = [json.loads(line) for line in answer.splitlines()]
    assert lines[-1] == {"id": 7, "end": True}
    assert len(lines) == (302 if ask == "state" else 4)
    wait_until(lambda: not server._clients)


def test_who_waits_for_pongs_and_goes_is_let_go(
    server: LocalSocketServer, source: Source, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(server_module, "LOOK_S", 0.05)
    source.mute = True
    with raw(server) as half:
        half.sendall(b'{"id":1,"ask":"ping","peer":"cloud-1","size":64}\n')
        half.shutdown(socket.SHUT_WR)
        wait_until(lambda: server._clients and not any(client.events for client in server._clients.values()))
        assert len(server._out) == 2
    wait_until(lambda: not server._clients)
    assert not server._out


def test_too_many_requests_are_refused(server: LocalSocketServer) -> None:
    with raw(server) as greedy, greedy.makefile("rb") as lines:
        errors = 0
        for number in range(int(STATES.owner.at_once) + 2):
            greedy.sendall(json.dumps({"id": number, "ask": "state"}).encode() + b"\n")
            while not (line := json.loads(lines.readline())).get("end"):
                if "error" in line:
                    errors += 1
                    break
    assert errors >= 1
    assert server.refused["too_often"] == errors


def test_who_asks_without_end_takes_little_time(server: LocalSocketServer) -> None:
    """Each refusal takes time of the interpreter, which the data plane needs."""
    began = time.monotonic()
    with raw(server) as greedy:
        greedy.setblocking(False)
        while server.refused["too_often"] < 4:
            assert time.monotonic() < began + PATIENCE_S
            with contextlib.suppress(BlockingIOError):
                greedy.sendall(b'{"id":1,"ask":"state"}\n' * 20)
            with contextlib.suppress(BlockingIOError):
                greedy.recv(65_536)
        assert server.refused["too_often"] <= (time.monotonic() - began) / server_module.REST_S + 1
        greedy.settimeout(PATIENCE_S)
        answer = b""
        while answer.count(b'"end":true') < 1:
            answer = answer[-100:] + greedy.recv(65_536)


def test_pings_that_are_out_are_bounded_and_forgotten(server: LocalSocketServer, source: Source) -> None:
    source.mute = True
    with raw(server) as greedy:
        asked = [{"id": number, "ask": "ping", "peer": "cloud-1", "size": 64} for number in range(200)]
        greedy.sendall(b"".join(json.dumps(one).encode() + b"\n" for one in asked))
        wait_until(lambda: server.refused["too_often"] > 0)
        assert len(server._out) <= MAX_REQUESTED_PINGS
    wait_until(lambda: not server._clients)
    assert not server._out


def test_a_ping_nobody_answers_ends(server: LocalSocketServer, source: Source, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(server_module, "PONG_WAIT_S", 0.1)
    monkeypatch.setattr(server_module, "LOOK_S", 0.05)
    source.mute = True
    with LocalClient(server.path) as client:
        client.ping("cloud-1", "wlan0", 64)
        assert (client.next_line(PATIENCE_S) or {}).get("part") == "pinged"
        assert (client.next_line(PATIENCE_S) or {}).get("end")
    assert not server._out


def test_a_source_that_fails_costs_its_client_only(
    server: LocalSocketServer, source: Source, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def failing() -> Iterator[tuple[str, Any]]:
        yield "node", {}
        raise RuntimeError("a bug")

    monkeypatch.setattr(source, "state", failing)
    with LocalClient(server.path) as client, pytest.raises(LocalError):
        client.state()
    monkeypatch.undo()
    with LocalClient(server.path) as client:
        assert client.state()["node"]
    assert "a bug" in caplog.text


def test_the_socket_of_a_killed_run_is_taken_over(tmp_path: Path, source: Source) -> None:
    path = tmp_path / "sidecar.sock"
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as left:
        left.bind(str(path))
    server = LocalSocketServer(path, source)
    server.open()
    server.close()


def test_the_socket_of_another_sidecar_and_other_files_are_left_alone(
    server: LocalSocketServer, source: Source, tmp_path: Path
) -> None:
    second = LocalSocketServer(server.path, source)
    with pytest.raises(LocalSocketError, match="another sidecar listens"):
        second.open()
    second.close()
    with LocalClient(server.path) as client:
        assert client.state()["node"]
    other = tmp_path / "file"
    other.write_text("precious")
    with pytest.raises(LocalSocketError, match="something other"):
        LocalSocketServer(other, source).open()
    assert other.read_text() == "precious"


def test_without_its_folder_it_says_why(tmp_path: Path, source: Source) -> None:
    with pytest.raises(LocalSocketError, match="No such file"):
        LocalSocketServer(tmp_path / "none" / "sidecar.sock", source).open()
