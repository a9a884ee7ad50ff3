"""plr-sidecar as a process: its command line, its exit codes, its life and its end."""

from __future__ import annotations

import json
import os
import re
import signal
import socket
import subprocess
import sys
import time
import urllib.request
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
import yaml

from lab.simulated.sessions import with_credential
from plr.protos.model.ids import InterfaceName, NodeName, Role, ServiceName, SessionId, Version
from plr.protos.model.mapping import Assignment, MappingSet, ServiceMapping
from plr.protos.model.members import CandidateSet, InterfaceLabel, Peer, PeerSet, Registration
from plr.protos.model.stream import Welcome
from plr.sidecar.state.store import StateStore
from tests.integration.scripted_control_plane import WAIT_S, ScriptedControlPlane
from tests.support.free_ports import free_port

if TYPE_CHECKING:
    from collections.abc import Iterator

ROOT = Path(__file__).parents[2]
ROS_DOMAIN = "88"


def environment() -> dict[str, str]:
    ros = {"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST", "ROS_DOMAIN_ID": ROS_DOMAIN}
    return {**os.environ, **ros, "PYTHONPATH": str(ROOT)}


def run(*arguments: str) -> subprocess.CompletedProcess[str]:
    argv = [sys.executable, "-m", "plr.sidecar", *arguments]
    return subprocess.run(argv, capture_output=True, text=True, timeout=60, env=environment())


class Program:
    """A running plr-sidecar whose data interface is the loopback one."""

    def __init__(self, folder: Path, **changes: Any) -> None:
        self.config = {
            "name": "robot-1",
            "role": "robot",
            "insecure": True,
            "control_plane": f"127.0.0.1:{free_port()}",
            "interfaces": ["lo"],
            "state_dir": str(folder / "state"),
            "metrics_listen": f"127.0.0.1:{free_port()}",
            "services": [{"name": "/plan_path", "deadline_ms": 100}],
            **changes,
        }
        self.path = folder / "sidecar.yaml"
        self.path.write_text(yaml.safe_dump(self.config))
        self._log_path = folder / "log"
        self._process: subprocess.Popen[bytes] | None = None

    def start(self) -> None:
        with self._log_path.open("wb") as log:
            argv = [sys.executable, "-m", "plr.sidecar", "--config", str(self.path)]
            self._process = subprocess.Popen(argv, stderr=log, env=environment())

    @property
    def process(self) -> subprocess.Popen[bytes]:
        assert self._process
        return self._process

    @property
    def log(self) -> str:
        return self._log_path.read_text()

    def wait_for_log(self, text: str) -> None:
        end = time.monotonic() + WAIT_S
        while text not in self.log:
            assert self.process.poll() is None, self.log
            assert time.monotonic() < end, self.log
            time.sleep(0.02)

    def end(self) -> int:
        return self.process.wait(WAIT_S)

    def metrics(self) -> str:
        with urllib.request.urlopen(f"http://{self.config['metrics_listen']}/metrics", timeout=WAIT_S) as response:
            text: str = response.read().decode()
            return text


@pytest.fixture
def program(tmp_path: Path) -> Iterator[Program]:
    program = Program(tmp_path)
    yield program
    if program._process is not None and program.process.poll() is None:
        program.process.kill()
        program.process.wait()


def test_help_and_version() -> None:
    shown = run("--help")
    assert shown.returncode == 0
    assert "examples:" in shown.stdout
    assert "exit codes:" in shown.stdout
    assert re.fullmatch(r"plr-sidecar \S+ \(protocol 3\)\n", run("--version").stdout)


def test_the_schema_is_json() -> None:
    shown = run("--print-schema")
    assert shown.returncode == 0
    assert "control_plane" in json.loads(shown.stdout)["properties"]


@pytest.mark.parametrize("arguments", [(), ("--check-config",), ("--confg", "x"), ("--config",)])
def test_wrong_usage_is_one_line_and_exit_2(arguments: tuple[str, ...]) -> None:
    shown = run(*arguments)
    assert shown.returncode == 2
    assert len(shown.stderr.splitlines()) == 1
    assert "--help" in shown.stderr


@pytest.mark.parametrize("check", [True, False])
@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"deadline": 1}, "deadline: unknown key"),
        (
            {"services": [{"name": "/a", "deadline_ms": "fast"}]},
            "services[0].deadline_ms: expected a number, got 'fast'",
        ),
    ],
)
def test_a_bad_config_is_one_line_and_exit_2(
    tmp_path: Path, changes: dict[str, Any], expected: str, check: bool
) -> None:
    program = Program(tmp_path, **changes)
    shown = run("--config", str(program.path), *(["--check-config"] if check else []))
    assert shown.returncode == 2
    last = shown.stderr.splitlines()[-1]
    assert last.startswith(f"plr-sidecar: {program.path}: ")
    assert expected in last
    assert not (check and len(shown.stderr.splitlines()) > 1)


def test_a_file_that_is_not_there_is_exit_2(tmp_path: Path) -> None:
    shown = run("--config", str(tmp_path / "none.yaml"))
    assert shown.returncode == 2
    assert shown.stderr == f"plr-sidecar: {tmp_path}/none.yaml: cannot be read: No such file or directory\n"


def test_a_good_config_is_ok(program: Program) -> None:
    shown = run("--config", str(program.path), "--check-config")
    assert (shown.returncode, shown.stdout, shown.stderr) == (0, f"{program.path}: ok\n", "")


@pytest.mark.audit("ops-1")
def test_an_interface_that_is_missing_is_warned_of(tmp_path: Path) -> None:
    program = Program(tmp_path, interfaces=["lo", "wwan99"])
    shown = run("--config", str(program.path), "--check-config")
    assert (shown.returncode, shown.stdout) == (0, f"{program.path}: ok\n")
    assert shown.stderr.startswith("plr-sidecar: warning: wwan99: there is no such interface now (there are: lo")


@pytest.mark.ros
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_runs_without_control_plane_and_stops_cleanly(program: Program, number: signal.Signals) -> None:
    program.start()
    program.wait_for_log("the sidecar continues without it")
    text = program.metrics()
    assert "plr_control_plane_connected 0.0" in text
    checked = subprocess.run(["promtool", "check", "metrics"], input=text, capture_output=True, text=True, timeout=60)
    assert (checked.returncode, checked.stdout, checked.stderr) == (0, "", "")
    program.process.send_signal(number)
    # A terminal and a supervisor may both pass it on.
    program.process.send_signal(number)
    assert program.end() == 0
    assert f"stopping on {number.name}" in program.log
    lines = program.log.splitlines()
    assert [line for line in lines if not re.match(r"\d{4}-\d\d-\d\dT[\d:.]+Z [A-Z]+ \S+: ", line)] == []
    assert " ERROR " not in program.log


INTERRUPTED_IMPORT = """
import signal, sys, types

class Runtime(types.ModuleType):
    def __getattr__(self, name):
        if name != "run":
            raise AttributeError(name)
        signal.raise_signal(signal.SIGTERM)
        return lambda config, version, stop: print("stopped", stop.wait(60.0)) or 0

sys.modules["plr.sidecar.runtime"] = Runtime("plr.sidecar.runtime")
from plr.sidecar.__main__ import main
sys.exit(main(sys.argv[1:]))
"""


def test_a_signal_that_comes_while_it_still_imports_is_heeded(program: Program) -> None:
    command = [sys.executable, "-c", INTERRUPTED_IMPORT, "--config", str(program.path)]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=WAIT_S)
    assert (ended.returncode, ended.stdout) == (0, "stopped on SIGTERM\n"), ended.stderr


CLOUD = with_credential(Peer(NodeName("cloud-a"), Role.CLOUD, SessionId(9), bytes(range(16)), incarnation=1))
PEERS = PeerSet(Version(11), 0, (CLOUD,))


def mapping(interface: str) -> MappingSet:
    pair = Assignment(InterfaceName(interface), NodeName("cloud-a"))
    return MappingSet(Version(12), 0, (ServiceMapping(ServiceName("/plan_path"), (pair,), 0.5),))


def remember(program: Program, *messages: PeerSet | MappingSet) -> bytes:
    """Leave this on the program's disk; returns its token."""
    store = StateStore(Path(program.config["state_dir"]), NodeName("robot-1"))
    for message in messages:
        store.remember(message)
    store.close()
    return store.identity.token


@pytest.mark.ros
def test_starts_from_the_disk_while_the_control_plane_is_down_then_registers_with_it(program: Program) -> None:
    token = remember(program, PEERS, mapping("lo"))
    program.start()
    program.wait_for_log("started from the mapping kept on disk")
    program.wait_for_log("the sidecar continues without it")
    assert "plr_mapping_version 12.0" in program.metrics()
    port = int(str(program.config["control_plane"]).rsplit(":", 1)[1])
    with ScriptedControlPlane(port, welcome=Welcome(3.0, 0.5)) as control_plane:
        registration = control_plane.expect(Registration)
        program.wait_for_log("registered with the control plane")
    assert registration.token == token
    assert (registration.peers_version, registration.mapping_version) == (11, 12)
    program.process.send_signal(signal.SIGTERM)
    assert program.end() == 0


@pytest.mark.ros
def test_a_mapping_on_disk_that_no_longer_fits_is_asked_for_again(program: Program) -> None:
    remember(program, PEERS, mapping("wlan99"))
    with ScriptedControlPlane(welcome=Welcome(3.0, 0.5)) as control_plane:
        program.config["control_plane"] = control_plane.target
        program.config["networks"] = [{"interface": "l*", "carrier": "own", "cost_per_request": 2}]
        program.path.write_text(yaml.safe_dump(program.config))
        program.start()
        registration = control_plane.expect(Registration)
        assert (registration.peers_version, registration.mapping_version) == (11, 0)
        told = control_plane.expect(CandidateSet)
        assert told.labels == (InterfaceLabel(InterfaceName("lo"), "own", 2.0),)
        program.process.send_signal(signal.SIGTERM)
        assert program.end() == 0
    assert "the mapping kept on disk no longer fits" in program.log


@pytest.mark.ros
def test_a_mapping_on_disk_is_in_force_as_soon_as_it_fits_and_stays_on_the_disk(program: Program) -> None:
    remember(program, PeerSet(Version(10), 0, ()), mapping("lo"))
    with ScriptedControlPlane(welcome=Welcome(3.0, 0.5)) as control_plane:
        program.config["control_plane"] = control_plane.target
        program.path.write_text(yaml.safe_dump(program.config))
        program.start()
        program.wait_for_log("registered with the control plane")
        assert "plr_mapping_version 0.0" in program.metrics()
        control_plane.say(PEERS)
        program.wait_for_log("mapping version 12, which was refused before, is in force now")
        assert "plr_mapping_version 12.0" in program.metrics()
        program.process.send_signal(signal.SIGTERM)
        assert program.end() == 0
    program.start()
    program.wait_for_log("started from the mapping kept on disk")
    program.process.send_signal(signal.SIGTERM)
    assert program.end() == 0


@pytest.mark.ros
def test_what_cannot_be_had_now_is_exit_1_and_says_which_key(program: Program) -> None:
    store = StateStore(Path(program.config["state_dir"]), NodeName("robot-1"))
    program.start()
    assert program.end() == 1
    store.close()
    assert f"plr-sidecar: {program.path}: state_dir: expected a folder of its own" in program.log


@pytest.mark.ros
@pytest.mark.audit("ops-7")
def test_who_has_the_port_of_the_metrics_does_not_keep_a_robot_without_its_sidecar(program: Program) -> None:
    host, port = str(program.config["metrics_listen"]).split(":")
    with socket.create_server((host, int(port))):
        program.start()
        program.wait_for_log("metrics_listen: cannot listen on")
        program.process.send_signal(signal.SIGTERM)
        assert program.end() == 0
