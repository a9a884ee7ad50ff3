"""`plr status`, `plr events` and `plr explain` tell of who is gone, also after the control plane was killed."""

from __future__ import annotations

import contextlib
import json
import signal
import threading
import time
from typing import TYPE_CHECKING, Any

import grpc
import pytest

from plr.controlplane.cli.__main__ import main
from plr.controlplane.core.explain.faults import FLAPS
from plr.protos.model.report import Report
from plr.protos.trust.identity import IdentityRole
from tests.support.control_plane_process import HEARTBEAT_S, PATIENCE_S, ControlPlaneProcess, Sidecar, cloud, robot
from tests.support.samples import path
from tests.support.secured_control_plane import SecuredControlPlane

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

pytestmark = pytest.mark.audit("ops-11")


class Operator:
    """Asks with `plr`."""

    def __init__(self, address: str, capsys: pytest.CaptureFixture[str], *security: str) -> None:
        self._options = (*(security or ("--insecure",)), "--address", address)
        self._capsys = capsys

    def ask(self, command: str, *arguments: str) -> str:
        assert main([command, *self._options, *arguments]) == 0
        return self._capsys.readouterr().out

    def gone(self) -> dict[str, str]:
        status = json.loads(self.ask("status", "--json"))
        return {one["name"]: one["reason"] for one in status.get("departed", ())}

    def events(self, *arguments: str) -> list[dict[str, Any]]:
        return [json.loads(line) for line in self.ask("events", "--json", *arguments).splitlines()]

    def wait_until(self, condition: Callable[[], bool]) -> None:
        end = time.monotonic() + PATIENCE_S
        while not condition():
            assert time.monotonic() < end, self.events()
            time.sleep(0.05)


@contextlib.contextmanager
def alive(sidecar: Sidecar) -> Iterator[None]:
    """It renews its lease meanwhile."""
    over = threading.Event()

    def beat() -> None:
        while not over.wait(HEARTBEAT_S):
            sidecar.beat()

    thread = threading.Thread(target=beat)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()


def kinds(events: list[dict[str, Any]]) -> list[str]:
    return [event["kind"] for event in events]


def test_who_is_gone_is_shown_and_explained(alone: ControlPlaneProcess, capsys: pytest.CaptureFixture[str]) -> None:
    operator = Operator(alone.address, capsys)
    with cloud(alone.address, "cloud-a") as a:
        with alive(a):
            r = robot(alone.address)
            r.mapping("cloud-a", "cloud-a")
            r.kill()
            operator.wait_until(lambda: "robot" in operator.gone())
    operator.wait_until(lambda: "cloud-a" in operator.gone())
    assert operator.gone()["cloud-a"] == "DEPARTURE_REASON_DRAINED"
    text = operator.ask("status")
    assert "gone sidecars, newest first:" in text
    assert "lease_expired: not heard by the control plane for longer than its lease" in text
    assert kinds(operator.events("--node", "robot")) == ["connected", "stream_lost", "departed"]
    assert operator.events("--last", "1") == operator.events()[-1:]
    assert main(["events", "--insecure", "--address", alone.address, "--node", "rbot"]) == 0
    assert capsys.readouterr() == ("", "plr: no event of rbot was found; plr status shows how names are spelled\n")
    assert main(["status", "--insecure", "--address", alone.address, "rbot"]) == 1
    text, told = capsys.readouterr()
    assert "no sidecars" not in text
    assert told == "plr: rbot is not registered; plr status shows which are, plr events --node rbot shows its past\n"
    assert "robot IS GONE" in operator.ask("explain", "robot", "/plan")
    alone.stop_flawless()


def test_a_control_plane_that_was_killed_remembers(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with ControlPlaneProcess(tmp_path) as plane:
        operator = Operator(plane.address, capsys)
        a = cloud(plane.address, "cloud-a")
        with cloud(plane.address, "cloud-b"):
            operator.wait_until(lambda: kinds(operator.events()).count("connected") == 2)
        operator.wait_until(lambda: operator.gone() == {"cloud-b": "DEPARTURE_REASON_DRAINED"})
        log = tmp_path / "state" / "events.jsonl"
        operator.wait_until(lambda: "drained" in log.read_text())
        plane.stop(signal.SIGKILL)
        a.kill()
    with log.open("a") as file:
        file.write('{"number": 12')
    with ControlPlaneProcess(tmp_path, lease_ms=500, warm_up_ms=0) as plane:
        operator = Operator(plane.address, capsys)
        assert kinds(operator.events())[0] == "started"
        operator.wait_until(lambda: set(operator.gone()) == {"cloud-a", "cloud-b"})
        assert "before the control plane was restarted" in operator.ask("events", "--node", "cloud-a")
        assert "1 damaged lines" in operator.ask("status")
        plane.stop_flawless()


def test_a_revoked_member_is_gone_and_what_it_tries_is_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with SecuredControlPlane(tmp_path) as plane:
        plane.authority.write_tls_dir(tmp_path / "alice", "alice", IdentityRole.OPERATOR)
        operator = Operator(plane.address, capsys, "--tls-dir", str(tmp_path / "alice"))
        member = plane.member("robot-1")
        with robot(plane.address, "robot-1", member):
            operator.wait_until(lambda: kinds(operator.events("--node", "robot-1")) == ["connected"])
            plane.revoke("robot-1")
            operator.wait_until(lambda: operator.gone() == {"robot-1": "DEPARTURE_REASON_REVOKED"})
        with robot(plane.address, "robot-1", member) as again, pytest.raises(grpc.RpcError):
            again.next()
        operator.wait_until(lambda: "refused" in kinds(operator.events("--node", "robot-1")))
        plane.stop_flawless()


def test_a_flapping_interface_is_told(alone: ControlPlaneProcess, capsys: pytest.CaptureFixture[str]) -> None:
    operator = Operator(alone.address, capsys)
    with cloud(alone.address, "cloud-a") as a, alive(a), robot(alone.address) as r:
        r.mapping("cloud-a", "cloud-a")
        for number in range(1 + FLAPS):
            r.send(Report(paths=(path("wlan0", "cloud-a"), path("wwan0", "cloud-a", up=number % 2 == 0))))

        def flaps() -> bool:
            r.send(Report(paths=(path("wlan0", "cloud-a"), path("wwan0", "cloud-a"))))
            return "flapping" in kinds(operator.events("--node", "robot"))

        operator.wait_until(flaps)
        (told,) = [event for event in operator.events("--node", "robot") if event["kind"] == "flapping"]
        assert told["text"] == "wwan0: it, or a path over it, went up or down 6 times in the last 5 min"
        assert "wwan0 FLAPPING: it, or a path over it, went up or down 6 times" in operator.ask("status")
    alone.stop_flawless()


def test_a_wrong_time_is_told_with_the_right_ones(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["events", "--insecure", "--since", "yesterday"])
    assert "30m, 2h, 7d" in capsys.readouterr().err
