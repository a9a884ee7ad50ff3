"""A fleet is upgraded in any order: the programs of this checkout beside those of an earlier commit."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import pytest
import yaml

from tests.ros.processes import Program
from tests.support.free_ports import free_port

if TYPE_CHECKING:
    from types import TracebackType

ROOT = Path(__file__).parents[2]
EARLIER = "362d2b2c4aba1469b082b94b3197072d64029688"
"""Speaks protocol version 3, and knows nothing of ranges of versions."""
SERVICE = "/plan"
PATIENCE_S = 60.0
"""Bounds only how long a broken test hangs."""


@pytest.fixture(scope="module")
def earlier(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The packages as they were then."""
    folder = tmp_path_factory.mktemp("earlier")
    argv = ["git", "-C", str(ROOT), "archive", EARLIER, "protos", "sidecar", "controlplane"]
    try:
        archive = subprocess.run(argv, capture_output=True, check=True).stdout
    except (OSError, subprocess.CalledProcessError):
        pytest.skip(f"git has no commit {EARLIER[:12]} here: a shallow clone, or no clone")
    subprocess.run(["tar", "-xC", folder], input=archive, check=True)
    assert not (folder / "protos" / "protocol_versions.py").exists()
    return folder


class Fleet:
    """A control plane, a cloud and a robot on loopback, each of either code, and changed from one to the other."""

    def __init__(self, folder: Path, robot_domain: int, cloud_domain: int) -> None:
        self.folder = folder
        self.domains = {"robot": robot_domain, "cloud": cloud_domain, "control": cloud_domain}
        self._running: dict[str, subprocess.Popen[bytes]] = {}
        self._programs: list[Program] = []
        port, stun = free_port(), free_port(socket.SOCK_DGRAM)
        address = f"127.0.0.1:{port}"
        self._configure(
            "control",
            listen=address,
            stun_listen=[f"127.0.0.1:{stun}"],
            stun_servers=[f"127.0.0.1:{stun}"],
            report_interval_ms=100,
        )
        both = {"control_plane": address, "interfaces": ["lo"]}
        self._configure("cloud", role="cloud", udp_port=free_port(socket.SOCK_DGRAM), services=[SERVED], **both)
        self._configure("robot", role="robot", services=[USED], **both)

    def _configure(self, part: str, **keys: Any) -> None:
        if part != "control":
            keys["name"] = part
        shared = {"insecure": True, "metrics_listen": None, "state_dir": str(self.folder / part)}
        (self.folder / f"{part}.yaml").write_text(yaml.safe_dump(shared | keys))

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        for program in self._programs:
            program.__exit__(None, None, None)
        for process in self._running.values():
            process.kill()
            process.wait()

    def run(self, part: str, code: Path) -> None:
        """Start a part of this code, in place of the one that runs."""
        before = self._running.pop(part, None)
        if before is not None:
            before.send_signal(signal.SIGTERM)
            assert before.wait(PATIENCE_S) == 0, self.log(part)
        module = "controlplane" if part == "control" else "sidecar"
        if (code / "plr").is_dir():  # Since the packages have a name that nobody else has.
            module = f"plr.{module}"
        environment = {
            **os.environ,
            "PYTHONPATH": str(code),
            "ROS_DOMAIN_ID": str(self.domains[part]),
            "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
            "ROS_LOG_DIR": str(self.folder / "ros-logs"),
        }
        argv = [sys.executable, "-m", module, "--config", str(self.folder / f"{part}.yaml")]
        with self._log(part).open("ab") as log:
            self._running[part] = subprocess.Popen(argv, stderr=log, env=environment, cwd=code)

    def _log(self, part: str) -> Path:
        return self.folder / f"{part}.log"

    def log(self, part: str) -> str:
        return self._log(part).read_text()

    def wait_for(self, part: str, text: str, times: int) -> None:
        """Wait until the part's log has said this so often, over all its runs."""
        end = time.monotonic() + PATIENCE_S
        while self.log(part).count(text) < times:
            assert self._running[part].poll() is None, self.log(part)
            assert time.monotonic() < end, f"{text!r} is not in {self.log(part)}"
            time.sleep(0.05)

    def serve(self) -> None:
        """Start the server that the cloud carries."""
        self._app("server", "cloud", "serve", "--plan", SERVICE)

    def call(self, name: str) -> dict[str, Any]:
        """What an application sees that calls the service ten times."""
        app = self._app(name, "robot", "call", SERVICE, "--count", "10")
        assert app.wait(PATIENCE_S) == 0, app.output()
        seen: dict[str, Any] = json.loads(app.output().splitlines()[-1])
        return {"answered": seen["answered"], "wrong": seen["wrong"], "twice": seen["twice"]}

    def _app(self, name: str, part: str, *arguments: str) -> Program:
        program = Program(name, ["-m", "tests.ros.app", *arguments], self.domains[part], self.folder)
        self._programs.append(program)
        return program


SERVED = {"name": SERVICE}
ALL = {"answered": 10, "wrong": 0, "twice": 0}
USED = {"name": SERVICE, "deadline_ms": 1000, "lifetime_ms": 10_000, "idempotent": True}


@pytest.mark.audit("ops-10")
@pytest.mark.ros
@pytest.mark.timeout(300)
def test_a_fleet_is_upgraded_in_any_order(earlier: Path, tmp_path: Path, robot_domain: int, ros_domain: int) -> None:
    with Fleet(tmp_path, robot_domain, ros_domain) as fleet:
        fleet.serve()
        # The robot first: it meets an older control plane and an older cloud.
        fleet.run("control", earlier)
        fleet.run("cloud", earlier)
        fleet.run("robot", ROOT)
        fleet.wait_for("robot", "is offered here", 1)
        assert fleet.call("first") == ALL
        # Now the control plane, under their streams.
        fleet.run("control", ROOT)
        for part in ("robot", "cloud"):
            fleet.wait_for(part, "registered", 2)
        assert fleet.call("second") == ALL
        # Now the cloud, and the robot back: an older robot meets a newer control plane and a newer cloud.
        fleet.run("cloud", ROOT)
        fleet.run("robot", earlier)
        fleet.wait_for("robot", "is offered here", 2)
        assert fleet.call("third") == ALL
        said = "".join(map(fleet.log, ("control", "robot", "cloud")))
        assert "speaks protocol version" not in said
        assert "refused a message" not in said
