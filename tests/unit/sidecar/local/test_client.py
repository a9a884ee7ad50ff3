"""What the client makes of something that listens in a sidecar's place, and says anything."""

from __future__ import annotations

import contextlib
import json
import socket
import threading
import tracemalloc
from typing import TYPE_CHECKING, Any

import pytest

from plr.sidecar.doctor import command, ping_command
from plr.sidecar.local.client import MAX_ANSWER_LINE_BYTES, LocalClient, LocalError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

pytestmark = pytest.mark.audit("ops-14")

PATH = {"interface": "wlan0", "peer": "cloud-1", "remote": 0, "state": "up"}
CLEAR = "\x1b[2J\x1b]0;title\x07\nnext \u202e"


class Impostor:
    """Answers each request with what `say` makes of its id."""

    def __init__(self, path: Path) -> None:
        self.say: Callable[[int], Iterator[bytes]] = lambda _: iter(())
        self._sock = socket.socket(socket.AF_UNIX)
        self._sock.bind(str(path))
        self._sock.listen()
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self) -> None:
        while True:
            try:
                sock, _ = self._sock.accept()
            except OSError:
                return
            with sock, contextlib.suppress(OSError), sock.makefile("rb") as lines:
                for line in lines:
                    for data in self.say(json.loads(line)["id"]):
                        sock.sendall(data)

    def close(self) -> None:
        self._sock.shutdown(socket.SHUT_RDWR)
        self._sock.close()
        self._thread.join()


@pytest.fixture
def impostor(tmp_path: Path) -> Iterator[Impostor]:
    impostor = Impostor(tmp_path / "s")
    yield impostor
    impostor.close()


def line(**said: Any) -> bytes:
    return json.dumps(said).encode() + b"\n"


def parts(value: Any) -> Callable[[int], Iterator[bytes]]:
    names = (
        "node paths services certificate clock mapping mapped control interfaces idle gone refused_peers removed_peers "
        "removed_counts pinged pong"
    )

    def say(number: int) -> Iterator[bytes]:
        for name in names.split():
            yield line(id=number, part=name, value=value)
        yield line(id=number, end=True)

    return say


STRANGE: dict[str, Callable[[int], Iterator[bytes]]] = {
    "deep": lambda _: iter([b"[" * 200_000 + b"\n"]),
    "long": lambda _: iter([b'"' + b"x" * (MAX_ANSWER_LINE_BYTES + 1) + b"\n"]),
    "text": parts("x"),
    "number": parts(7),
    "list": parts([1]),
    "huge number": lambda n: iter([b'{"id":%d,"part":"clock","value":{"floor":%s}}\n' % (n, b"9" * 5000)]),
    "not a number": lambda n: iter([b'{"id":%d,"part":"clock","value":{"floor":NaN}}\n' % n]),
    "keyless": lambda n: iter([line(id=n, part="paths", value=[{"state": "up"}]), line(id=n, end=True)]),
    "id": lambda _: iter([line(id={}, end=True)]),
    "binary": lambda _: iter([bytes(range(256)), b"\n"]),
    "error": lambda n: iter([line(id=n, error=CLEAR)]),
}


@pytest.mark.parametrize("kind", STRANGE)
def test_strange_answers_are_one_line_of_error(tmp_path: Path, impostor: Impostor, kind: str) -> None:
    impostor.say = STRANGE[kind]
    with LocalClient(tmp_path / "s") as client:
        with pytest.raises(LocalError) as failed:
            client.state()
        assert str(failed.value).isprintable()


def test_an_answer_without_end_costs_little_memory(
    tmp_path: Path, impostor: Impostor, monkeypatch: pytest.MonkeyPatch
) -> None:
    def without_end(number: int) -> Iterator[bytes]:
        part = line(id=number, part="paths", value=[PATH] * 400)
        while True:
            yield part

    impostor.say = without_end
    most_bytes = 1 << 20
    monkeypatch.setattr("plr.sidecar.local.client.MAX_STATE_BYTES", most_bytes)
    tracemalloc.start()
    try:
        with (
            LocalClient(tmp_path / "s") as client,
            pytest.raises(LocalError, match=f"more than {most_bytes} bytes"),
        ):
            client.state()
        _, most = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert most < 20 * most_bytes


@pytest.mark.parametrize("kind", STRANGE)
def test_ping_says_one_line(tmp_path: Path, impostor: Impostor, kind: str, capsys: pytest.CaptureFixture[str]) -> None:
    impostor.say = STRANGE[kind]
    at = ["--socket", str(tmp_path / "s"), "--config", str(tmp_path / "none")]
    assert ping_command.main(["cloud-1", "-c", "1", "-W", "0.2", *at]) == 1
    shown = capsys.readouterr()
    assert shown.out == ""
    assert shown.err.count("\n") <= 1
    assert shown.err.rstrip("\n").isprintable()


def test_what_is_printed_moves_no_cursor(
    tmp_path: Path, impostor: Impostor, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def say(number: int) -> Iterator[bytes]:
        path = {**PATH, "interface": CLEAR, "peer": CLEAR, "reason": CLEAR}
        yield line(id=number, part="node", value={"name": CLEAR, "role": "robot", "environment": {"A": CLEAR}})
        yield line(id=number, part="paths", value=[path])
        yield line(id=number, part="pinged", value=[{"interface": CLEAR, "remote": 0}])
        yield line(id=number, part="pong", value={"interface": CLEAR, "remote": 0, "rtt_s": 0.1, "problem": CLEAR})
        yield line(id=number, end=True)

    impostor.say = say
    monkeypatch.setattr("plr.sidecar.ros.environment.problem", lambda *_, **__: None)
    at = ["--socket", str(tmp_path / "s"), "--config", str(tmp_path / "none")]
    ping_command.main(["cloud-1", "-c", "1", *at])
    command.main(at)
    command.main([*at, "--json"])
    shown = capsys.readouterr()
    assert "x1b[2J" in shown.out
    assert (shown.out + shown.err).replace("\n", "").isprintable()


def test_ping_says_that_nobody_answers(tmp_path: Path, impostor: Impostor, capsys: pytest.CaptureFixture[str]) -> None:
    at = ["--socket", str(tmp_path / "s"), "--config", str(tmp_path / "none")]
    assert ping_command.main(["cloud-1", "-c", "1", "-W", "0.2", *at]) == 1
    assert capsys.readouterr().err == "plr ping: the sidecar does not answer: it is stopped, or very busy\n"


def test_statistics_are_shown_of_a_sidecar_that_ended(
    tmp_path: Path, impostor: Impostor, capsys: pytest.CaptureFixture[str]
) -> None:
    def say(number: int) -> Iterator[bytes]:
        if number == 2:
            raise ConnectionError
        yield line(id=number, part="pinged", value=[{"interface": "wlan0", "remote": 0}])
        yield line(id=number, part="pong", value={"interface": "wlan0", "remote": 0, "rtt_s": 0.1, "problem": ""})
        yield line(id=number, end=True)

    impostor.say = say
    at = ["--socket", str(tmp_path / "s"), "--config", str(tmp_path / "none")]
    assert ping_command.main(["cloud-1", "-c", "4", "-i", "0.1", *at]) == 1
    shown = capsys.readouterr()
    assert "1 sent, 1 answered, 0 % lost" in shown.out
    assert shown.err == "plr ping: the sidecar closed the connection: it ended, or is busy with others\n"


def test_pings_that_were_refused_are_not_lost(
    tmp_path: Path, impostor: Impostor, capsys: pytest.CaptureFixture[str]
) -> None:
    def say(number: int) -> Iterator[bytes]:
        if number == 3:
            yield line(id=number, error="too many requests: wait a second", busy=True)
            return
        yield line(id=number, part="pinged", value=[{"interface": "wlan0", "remote": 0}])
        problem = "too many pings" if number == 2 else ""
        yield line(id=number, part="pong", value={"interface": "wlan0", "remote": 0, "rtt_s": 0.1, "problem": problem})
        yield line(id=number, end=True)

    impostor.say = say
    at = ["--socket", str(tmp_path / "s"), "--config", str(tmp_path / "none")]
    assert ping_command.main(["cloud-1", "-c", "4", "-i", "0.1", *at]) == 0
    shown = capsys.readouterr().out.splitlines()
    assert shown[-2].startswith("wlan0 to cloud-1: 2 sent, 2 answered, 0 % lost, 1 not sent")
    assert shown[-1] == "1 requests were refused: the sidecar was busy with others"


def test_pongs_nobody_asked_for_are_not_counted(
    tmp_path: Path, impostor: Impostor, capsys: pytest.CaptureFixture[str]
) -> None:
    def say(number: int) -> Iterator[bytes]:
        yield line(id=number, part="pinged", value=[{"interface": "wlan0", "remote": 0}] * 50)
        for remote in range(100):
            for _ in range(2):
                value = {"interface": "wlan0", "remote": remote, "rtt_s": 0.1, "problem": ""}
                yield line(id=number, part="pong", value=value)
        yield line(id=number, end=True)

    impostor.say = say
    at = ["--socket", str(tmp_path / "s"), "--config", str(tmp_path / "none")]
    ping_command.main(["cloud-1", "-c", "1", "--json", *at])
    assert json.loads(capsys.readouterr().out) == [
        {"interface": "wlan0", "remote": 0, "sent": 1, "unsent": 0, "rtts_s": [0.1]}
    ]
