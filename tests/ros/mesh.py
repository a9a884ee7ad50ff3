"""One robot bridge and one cloud bridge in this process, joined by a loopback, each in its own ROS domain; the
applications around them are separate processes."""

from __future__ import annotations

import contextlib
import json
import signal
import subprocess
import threading
import time
from typing import TYPE_CHECKING, Any

from plr.protos.model.ids import Role
from plr.sidecar.core.rules.service_rule import ServiceRule
from plr.sidecar.ros.bridge import RosBridge
from tests.ros.loopback import Faults, Loopback
from tests.ros.processes import Program

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path
    from types import TracebackType

WAIT_S = 30.0
PATIENCE_AT_END_S = 10.0
POLL_S = 0.01
RULES = (ServiceRule("/*", deadline_s=0.1, lifetime_s=5.0),)


def no_name(_endpoint: bytes, _now: float) -> str | None:
    """As if only rmw knew names of nodes."""
    return None


def wait_until(happened: Callable[[], object], what: str, timeout_s: float = WAIT_S) -> None:
    """Poll until `happened()` is true."""
    end = time.monotonic() + timeout_s
    while not happened():
        assert time.monotonic() < end, f"not seen: {what}"
        time.sleep(POLL_S)


class Mesh:
    """Started by `start`; everything in it has ended when the `with` block is left."""

    def __init__(self, robot_domain: int, cloud_domain: int, folder: Path) -> None:
        self.robot_domain = robot_domain
        self.cloud_domain = cloud_domain
        self.folder = folder
        self.faults = Faults()
        self.robot = self._bridge("robot-1", Role.ROBOT, RULES)
        self.cloud = self._bridge("cloud-1", Role.CLOUD, RULES)
        self.link = Loopback(self.robot, self.cloud, self.faults)
        self.environment: dict[str, str] = {}
        """Added to that of the programs started from now on."""
        self._programs: list[Program] = []
        self._count = 0

    def _bridge(self, name: str, role: Role, rules: tuple[ServiceRule, ...]) -> RosBridge:
        domain = self.robot_domain if role is Role.ROBOT else self.cloud_domain
        return RosBridge(name=name, role=role, rules=rules, domain_id=domain)

    def use_rules(self, *rules: ServiceRule) -> None:
        """Replace the rules of both bridges; before `start`."""
        self.robot = self._bridge("robot-1", Role.ROBOT, rules)
        self.cloud = self._bridge("cloud-1", Role.CLOUD, rules)
        self.link.robot_app, self.link.cloud_app = self.robot, self.cloud

    def __enter__(self) -> Mesh:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        for program in self._programs:
            with program, contextlib.suppress(subprocess.TimeoutExpired):
                # A killed one leaves its shared memory behind, but now and then rclpy does not end by itself.
                program.stop(signal.SIGTERM, PATIENCE_AT_END_S)
        stopped = self.robot.stop(), self.cloud.stop()
        self.link.stop()
        if kind is None:
            assert stopped == (True, True)
            assert not [thread.name for thread in threading.enumerate() if thread.name == "plr-ros"]
            assert not self.robot.stats.errors.keys() - {"type_not_installed", "service_refused"}
            assert not self.cloud.stats.errors.keys() - {"type_not_installed", "service_refused"}

    def start(self) -> None:
        """Start both bridges."""
        self.robot.start(self.link.robot)
        self.cloud.start(self.link.cloud)

    def run(self, domain: int, *arguments: str, module: str = "tests.ros.app") -> Program:
        """Start a program of the tests with these arguments."""
        self._count += 1
        program = Program(f"app{self._count}", ["-m", module, *arguments], domain, self.folder, self.environment)
        self._programs.append(program)
        return program

    def serve(self, *arguments: str, domain: int | None = None) -> Program:
        """Start a server in the cloud's domain; returns once it is ready."""
        program = self.run(self.cloud_domain if domain is None else domain, "serve", *arguments)
        wait_until(lambda: "ready" in program.output(), f"a server: {program.output()}")
        return program

    def call(self, *arguments: str, domain: int | None = None) -> Program:
        """Start an application on the robot."""
        return self.run(self.robot_domain if domain is None else domain, "call", *arguments)

    def result(self, program: Program, timeout_s: float = WAIT_S) -> dict[str, Any]:
        """What an application printed when it was through."""
        assert program.wait(timeout_s) == 0, program.output()
        result: dict[str, Any] = json.loads(program.output().splitlines()[-1])
        return result

    def wait_carried(self, *services: str) -> None:
        """Wait until exactly these services are proxied on the robot."""
        wait_until(
            lambda: self.link.carried == frozenset(services), f"{services}, but {set(self.link.carried)} is carried"
        )
