"""plr doctor, ping and bugreport against the real programs, as somebody at the node types them."""

from __future__ import annotations

import base64
import json
import signal
import stat
import subprocess
import sys
import tarfile
import time
import urllib.request
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

from plr.controlplane.ca import Authority
from plr.protos.program import commit
from plr.protos.trust.identity import IdentityRole
from plr.sidecar.doctor import command, ping_command
from plr.sidecar.local.client import LocalClient
from plr.sidecar.state.file import decode_identity
from tests.integration.test_sidecar_program import Program, environment
from tests.support.control_plane_process import ControlPlaneProcess
from tests.support.free_ports import free_port

if TYPE_CHECKING:
    from collections.abc import Iterator

STARTS_S = 100.0
"""Only bounds how long a broken test hangs."""

pytestmark = [pytest.mark.audit("ops-14"), pytest.mark.ros]


def plr(*arguments: str) -> subprocess.CompletedProcess[str]:
    argv = [sys.executable, "-m", "plr.protos.program.command_line", *arguments]
    return subprocess.run(argv, capture_output=True, text=True, timeout=100, env=environment())


def wait_for_log(program: Program, text: str) -> None:
    """As the program's own, with the patience that three starts at once take on a busy machine."""
    end = time.monotonic() + STARTS_S
    while text not in program.log:
        assert program.process.poll() is None, program.log
        assert time.monotonic() < end, program.log
        time.sleep(0.05)


@pytest.fixture(scope="module")
def robot(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Program]:
    """A robot with a path to a cloud, both over the loopback interface."""
    common = {"stun": {"enabled": False}, "metrics_listen": None}
    with ControlPlaneProcess(tmp_path_factory.mktemp("plane")) as plane:
        cloud = Program(
            tmp_path_factory.mktemp("cloud"), name="cloud-1", role="cloud", udp_port=free_port(),
            control_plane=plane.address, services=[{"name": "/plan_path"}], **common,
        )  # fmt: skip
        robot = Program(tmp_path_factory.mktemp("robot"), control_plane=plane.address, **common)
        try:
            for program in (cloud, robot):
                program.start()
            wait_for_log(robot, "path lo to cloud-1 is up")
            yield robot
        finally:
            for program in (robot, cloud):
                if program._process is not None:
                    program.process.kill()
                    program.process.wait()


def doctor(program: Program) -> tuple[int, dict[str, Any]]:
    shown = plr("doctor", "--json", "--config", str(program.path))
    assert not shown.stderr
    return shown.returncode, json.loads(shown.stdout)


def test_the_doctor_sees_and_pings_the_path(robot: Program) -> None:
    code, seen = doctor(robot)
    assert code == 0, seen["findings"]
    assert seen["sidecar"]["node"]["name"] == "robot-1"
    found = {finding["check"]: finding for finding in seen["findings"]}
    assert found["path"]["level"] == "ok"
    assert "lo to cloud-1" in found["path"]["text"]
    assert "0 of 3 lost" in found["path"]["text"]
    assert (found["control"]["level"], found["domain"]["level"]) == ("ok", "ok")
    assert found["service"]["level"] == "warn"  # no server runs


def test_the_state_is_asked_for_without_a_trace_in_the_log(robot: Program) -> None:
    before = robot.log
    with LocalClient(Path(robot.config["state_dir"]) / "sidecar.sock") as client:
        (path,) = client.state()["paths"]
    assert (path["peer"], path["state"]) == ("cloud-1", "up")
    assert robot.log == before


def test_ping_prints_each_answer_and_the_statistics(robot: Program) -> None:
    shown = plr("ping", "cloud-1", "-c", "3", "-i", "0.1", "-s", "500", "--config", str(robot.path))
    assert (shown.returncode, shown.stderr) == (0, "")
    lines = shown.stdout.splitlines()
    assert [line.split(" time=")[0] for line in lines[:3]] == [f"lo to cloud-1: seq={number}" for number in (1, 2, 3)]
    assert lines[3].startswith("lo to cloud-1: 3 sent, 3 answered, 0 % lost, min/avg/P99/max ")


def test_ping_fails_where_nothing_answers(robot: Program, capsys: pytest.CaptureFixture[str]) -> None:
    assert ping_command.main(["cloud-9", "-c", "1", "--config", str(robot.path)]) == 1
    shown = capsys.readouterr()
    assert shown.out == ""
    assert "there is no path to cloud-9" in shown.err


@pytest.mark.parametrize("wrong", [["cloud-1", "-i", "0.01"], ["cloud-1", "-s", "9"], ["cloud-1", "-c", "0"], []])
def test_ping_refuses_bad_usage_in_one_line(wrong: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        ping_command.main(wrong)
    assert ended.value.code == 2
    assert len(capsys.readouterr().err.splitlines()) == 1


def test_without_sidecar_the_doctor_says_so_first_and_looks_at_the_rest(tmp_path: Path) -> None:
    program = Program(tmp_path)
    shown = plr("doctor", "--config", str(program.path))
    first, *rest = shown.stdout.splitlines()
    assert shown.returncode == 1
    assert first.startswith("fail  sidecar")
    assert "the sidecar is not running: nothing listens at" in first
    assert {line.split()[1] for line in rest} >= {"configuration", "clock", "ros", "domain", "interface"}


def test_a_wrong_configuration_is_a_failure_with_its_key(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("plr.sidecar.ros.environment.problem", lambda *_, **__: None)
    program = Program(tmp_path, deadline=1)
    assert command.main(["--config", str(program.path)]) == 1
    assert "deadline: unknown key" in capsys.readouterr().out
    with pytest.raises(SystemExit) as ended:
        command.main(["--nonsense"])
    assert ended.value.code == 2


def test_a_bugreport_holds_no_secret_and_the_socket_is_private(tmp_path: Path) -> None:
    authority = Authority.create()
    tls = tmp_path / "tls"
    tls.mkdir()
    authority.write_tls_dir(tls, "robot-1", IdentityRole.ROBOT, days=30.0)
    program = Program(tmp_path, insecure=False, tls_dir=str(tls))
    with program.path.open("a") as file:
        file.write("# the CA's passphrase: correct-horse-battery\n")
    program.start()
    try:
        wait_for_log(program, "the sidecar continues without it")
        sock = Path(program.config["state_dir"]) / "sidecar.sock"
        assert stat.S_IMODE(sock.stat().st_mode) & stat.S_IRWXO == 0
        report = tmp_path / "report.tar.gz"
        shown = plr("bugreport", "--config", str(program.path), "--output", str(report))
        assert (shown.returncode, shown.stderr) == (0, "")
        identity = decode_identity((Path(program.config["state_dir"]) / "identity").read_bytes())
        program.process.send_signal(signal.SIGTERM)
        assert program.end() == 0
        assert not sock.exists()
    finally:
        if program.process.poll() is None:
            program.process.kill()
            program.process.wait()
    assert stat.S_IMODE(report.stat().st_mode) == 0o600
    with tarfile.open(report) as tar:
        parts = {member.name.rpartition("/")[2]: _read(tar, member) for member in tar.getmembers()}
    assert parts.keys() >= {"doctor.json", "doctor.txt", "configuration.yaml", "versions.txt", "ip-route.txt"}
    assert f"\ncommit {commit.commit()}\n".encode() in parts["versions.txt"]
    assert b"plr_mapping_version" in parts["metrics.txt"]
    assert json.loads(parts["doctor.json"])["sidecar"]["node"]["name"] == "robot-1"
    assert b"tls_dir" in parts["configuration.yaml"]
    key_lines = (tls / "key.pem").read_bytes().splitlines()[1:-1]
    token = identity.token
    forbidden = [
        b"PRIVATE KEY", b"correct-horse-battery", token, token.hex().encode(), base64.b64encode(token), *key_lines,
    ]  # fmt: skip
    for name, data in parts.items():
        assert [secret for secret in forbidden if secret in data] == [], name


def test_broken_certificate_files_are_a_failure_while_the_sidecar_goes_on(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Only the next start would have shown it, with exit code 2."""
    tls = tmp_path / "tls"
    Authority.create().write_tls_dir(tls, "robot-1", IdentityRole.ROBOT)
    metrics = f"127.0.0.1:{free_port()}"
    program = Program(tmp_path, insecure=False, tls_dir=str(tls), metrics_listen=metrics)

    def is_refused() -> bool:
        with urllib.request.urlopen(f"http://{metrics}/metrics", timeout=STARTS_S) as answer:
            (value,) = (line for line in answer.read().decode().splitlines() if line.startswith("plr_tls_files_ref"))
        return float(value.split()[1]) == 1.0

    program.start()
    try:
        wait_for_log(program, "the sidecar continues without it")
        assert not is_refused()
        (tls / "ca.pem").write_bytes(b"")
        wait_for_log(program, "the next start fails")
        assert is_refused()
        assert command.main(["--json", "--no-ping", "--config", str(program.path)]) == 1
        seen = json.loads(capsys.readouterr().out)
        failed = [found for found in seen["findings"] if found["level"] == "fail" and found["check"] == "certificate"]
        assert [found["text"].partition(": ")[0] for found in failed] == [str(tls / "ca.pem")]
        assert seen["sidecar"]["certificate"]["refused"]["start"] is False
    finally:
        program.process.kill()
        program.process.wait()


def _read(tar: tarfile.TarFile, member: tarfile.TarInfo) -> bytes:
    file = tar.extractfile(member)
    assert file is not None
    return file.read()


def test_a_folder_that_is_not_there_is_a_warning_and_no_end(tmp_path: Path) -> None:
    program = Program(tmp_path, local_socket=str(tmp_path / "none" / "sidecar.sock"))
    program.start()
    try:
        wait_for_log(program, "so plr doctor sees only the configuration: No such file or directory")
        wait_for_log(program, "the sidecar continues without it")
    finally:
        program.process.kill()
        program.process.wait()
