"""The control plane as a program: configuration, exit codes, signals, systemd."""

from __future__ import annotations

import fcntl
import json
import os
import re
import signal
import socket
import subprocess
import sys
from typing import TYPE_CHECKING

import grpc
import pytest
import yaml

from plr.protos.model.stream import Welcome
from tests.support.control_plane_process import PATIENCE_S, ControlPlaneProcess, cloud

if TYPE_CHECKING:
    from pathlib import Path


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_ends_it_cleanly(tmp_path: Path, number: signal.Signals) -> None:
    with ControlPlaneProcess(tmp_path) as plane, cloud(plane.address, "cloud-a") as a:
        a.expect(Welcome)
        assert plane.stop(number) == 0
        code, details = a.end()
        assert code is grpc.StatusCode.UNAVAILABLE
        assert "stopping" in details
        assert plane.lines[-1].endswith("stopped")
        assert not [line for line in plane.lines if "Traceback" in line]


@pytest.mark.audit("ops-6")
def test_a_journal_that_stalls_holds_up_nobody(tmp_path: Path) -> None:
    reading, writing = os.pipe()
    size = fcntl.fcntl(writing, fcntl.F_SETPIPE_SZ, 4096)
    os.write(writing, b"x" * size)
    config = {"insecure": True, "listen": "127.0.0.1:0", "metrics_listen": "127.0.0.1:0", "stun_listen": []}
    with socket.create_server(("127.0.0.1", 0)) as free:
        config["listen"] = f"127.0.0.1:{free.getsockname()[1]}"
    (tmp_path / "controlplane.yaml").write_text(yaml.safe_dump(config))
    process = subprocess.Popen(
        [sys.executable, "-m", "plr.controlplane", "--config", str(tmp_path / "controlplane.yaml")], stderr=writing
    )
    try:
        with grpc.insecure_channel(str(config["listen"])) as channel:
            grpc.channel_ready_future(channel).result(PATIENCE_S)
        for number in range(3):
            with cloud(str(config["listen"]), f"cloud-{number}") as stream:
                stream.expect(Welcome)
        process.terminate()
        assert process.wait(PATIENCE_S) == 0
    finally:
        process.kill()
        process.wait()
        os.close(reading)
        os.close(writing)


def test_systemd_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as notified:
        notified.bind(str(tmp_path / "notify"))
        notified.settimeout(PATIENCE_S)
        monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "notify"))
        with ControlPlaneProcess(tmp_path) as plane:
            assert {notified.recv(100), notified.recv(100)} == {
                b"READY=1",
                b"STATUS=sidecars connected: 0 of robots, 0 of clouds",
            }
            with cloud(plane.address, "cloud-a") as stream:
                stream.expect(Welcome)
                assert notified.recv(100) == b"STATUS=sidecars connected: 0 of robots, 1 of clouds"
            assert plane.stop() == 0
            while (said := notified.recv(100)) != b"STOPPING=1":
                assert said.startswith(b"STATUS=")


def run(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "plr.controlplane", *arguments], capture_output=True, text=True, check=False
    )


def test_a_bad_configuration_ends_with_2_and_one_line(tmp_path: Path) -> None:
    config = tmp_path / "bad.yaml"
    config.write_text("lease_sm: 5000\n")
    done = run("--config", str(config))
    assert done.returncode == 2
    assert done.stderr == f"plr-controlplane: {config}: lease_sm: unknown key; did you mean lease_ms?\n"
    missing = run("--config", str(tmp_path / "none.yaml"))
    assert missing.returncode == 2
    assert missing.stderr.count("\n") == 1


def test_check_config_and_version(tmp_path: Path) -> None:
    config = tmp_path / "good.yaml"
    config.write_text("insecure: true\nlisten: 127.0.0.1:0\n")
    done = run("--config", str(config), "--check-config")
    assert (done.returncode, done.stdout) == (0, f"{config}: ok\n")
    assert re.fullmatch(r"plr-controlplane \S+ \(protocol 3\)\n", run("--version").stdout)
    assert run().returncode == 2


@pytest.mark.audit("ops-7")
@pytest.mark.parametrize(
    ("more", "told"),
    [
        ("policy:\n", "no robot may call any service"),
        ("policy: {}\n", "no robot may call any service"),
        ("stun_listen: 127.0.0.1:0\n", "stun_servers is empty"),
    ],
)
def test_check_config_warns_of_what_is_legal_and_hardly_meant(tmp_path: Path, more: str, told: str) -> None:
    config = tmp_path / "odd.yaml"
    config.write_text(f"insecure: true\nlisten: 127.0.0.1:0\nstun_servers: [127.0.0.1:3478]\n{more}")
    if "stun" in more:
        config.write_text(f"insecure: true\nlisten: 127.0.0.1:0\n{more}")
    done = run("--config", str(config), "--check-config")
    assert (done.returncode, done.stdout) == (0, f"{config}: ok\n")
    assert done.stderr.startswith("plr-controlplane: warning: ")
    assert done.stderr.count("\n") == 1
    assert told in done.stderr


@pytest.mark.audit("ops-7")
def test_wrong_usage_is_told_in_one_line() -> None:
    done = run()
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1
    assert done.stderr.endswith("see plr-controlplane --help\n")


def test_insecure_mode_is_refused_where_others_reach_it_unless_one_knows(tmp_path: Path) -> None:
    config = tmp_path / "exposed.yaml"
    config.write_text("insecure: true\n")
    done = run("--config", str(config), "--check-config")
    assert done.returncode == 2
    assert done.stderr.startswith(f"plr-controlplane: {config}: listen: expected a loopback address with insecure")
    assert run("--config", str(config), "--check-config", "--insecure-i-know").returncode == 0


def test_without_certificates_and_without_the_word_insecure_it_does_not_start(tmp_path: Path) -> None:
    config = tmp_path / "neither.yaml"
    cases = {
        "log_level: info": "tls_dir: expected the folder",
        "insecure: true\ntls_dir: /etc/plr/tls": "set one of the two",
    }
    for text, told in cases.items():
        config.write_text(text)
        done = run("--config", str(config))
        assert done.returncode == 2
        assert told in done.stderr
        assert done.stderr.count("\n") == 1


@pytest.mark.audit("ops-7")
@pytest.mark.parametrize(
    ("key", "kind"),
    [("listen", socket.SOCK_STREAM), ("stun_listen", socket.SOCK_DGRAM)],
)
def test_an_address_in_use_ends_with_1_and_names_the_key(tmp_path: Path, key: str, kind: socket.SocketKind) -> None:
    with socket.socket(socket.AF_INET, kind) as taken:
        taken.bind(("127.0.0.1", 0))
        if kind is socket.SOCK_STREAM:
            taken.listen()
        config = tmp_path / "controlplane.yaml"
        free = dict.fromkeys(("listen", "stun_listen", "metrics_listen"), "127.0.0.1:0")
        config.write_text(yaml.safe_dump({"insecure": True} | free | {key: f"127.0.0.1:{taken.getsockname()[1]}"}))
        done = run("--config", str(config))
    assert done.returncode == 1
    assert f"{key}: cannot listen on" in done.stderr
    assert "Traceback" not in done.stderr
    lines = done.stderr.splitlines()
    # Every line is ours, and why is said: gRPC would write one of its own before.
    assert [line for line in lines if not re.match(r"\d{4}-\d\d-\d\dT\S+ (WARNING|CRITICAL) controlplane", line)] == []
    assert lines[-1].endswith("Address already in use")


def test_the_schema_is_printed() -> None:
    done = subprocess.run(
        [sys.executable, "-m", "plr.controlplane.cli", "config", "schema", "controlplane"],
        capture_output=True,
        text=True,
        check=True,
    )
    assert "lease_ms" in json.loads(done.stdout)["properties"]
