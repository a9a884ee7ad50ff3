"""What of a configuration is in a report."""

from __future__ import annotations

import json
import socket
import threading
from typing import TYPE_CHECKING

import pytest
import yaml
from prometheus_client import CollectorRegistry, Gauge

from plr.protos.program.metrics_server import MetricsServer
from plr.sidecar.config.sidecar import load_config
from plr.sidecar.doctor import bugreport
from plr.sidecar.doctor.examination import Examination, Where
from plr.sidecar.doctor.finding import fail
from tests.unit.sidecar.configs import ROBOT

if TYPE_CHECKING:
    from pathlib import Path

pytestmark = pytest.mark.audit("ops-14")

WRONG = ROBOT | {"udp_port": "hunter2", "hunter2": 1, "api_tokens": ["hunter2"], "passwords": {"a": "hunter2"}}


@pytest.fixture(autouse=True)
def no_commands(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bugreport, "COMMANDS", {})


def test_of_one_that_is_wrong_the_known_keys(tmp_path: Path) -> None:
    path = tmp_path / "sidecar.yaml"
    path.write_text(yaml.safe_dump(WRONG))
    seen = Examination([fail("configuration", "udp_port: expected a whole number, got 'hunter2'", "correct it")])
    parts = dict(bugreport.parts(seen, Where(path)))
    assert "udp_port: (left out, because the configuration is invalid)\n" in parts["configuration.yaml"]
    assert parts["configuration.yaml"].endswith("# 3 unknown keys\n")
    assert [name for name, text in parts.items() if "hunter2" in text] == []


def test_of_one_that_is_right_all_values(tmp_path: Path) -> None:
    path = tmp_path / "sidecar.yaml"
    path.write_text(yaml.safe_dump(ROBOT))
    seen = Examination(config=load_config(path), state={"node": {"name": "robot-1", "secret": "hunter2"}})
    parts = dict(bugreport.parts(seen, Where(path)))
    told = yaml.safe_load(parts["configuration.yaml"])
    assert (told["name"], told["services"][0]["name"]) == ("robot-1", "/plan_path")
    assert json.loads(parts["doctor.json"])["sidecar"]["node"] == {"name": "robot-1", "secret": "(left out)"}


def test_what_is_no_configuration_says_why(tmp_path: Path) -> None:
    path = tmp_path / "sidecar.yaml"
    path.write_text("- passphrase hunter2")
    parts = dict(bugreport.parts(Examination(), Where(path)))
    assert "expected keys and values, got (left out)" in parts["configuration.yaml"]


def test_the_metrics_are_those_of_the_configured_port(tmp_path: Path) -> None:
    registry = CollectorRegistry()
    Gauge("plr_answer", "What is asked for.", registry=registry).set(42)
    server = MetricsServer("127.0.0.1", 0, registry)
    try:
        assert _metrics(tmp_path, server.port).endswith("plr_answer 42.0\n")
    finally:
        server.close()


def test_who_has_the_port_of_the_metrics_does_not_hold_up_a_report(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(bugreport, "METRICS_S", 0.3)
    done = threading.Event()

    def answer_slowly(server: socket.socket) -> None:
        connection, _ = server.accept()
        with connection:
            # A limit on each read never ends this.
            while not done.wait(0.05):
                connection.sendall(b"H")

    with socket.create_server(("127.0.0.1", 0)) as server:
        mallory = threading.Thread(target=answer_slowly, args=(server,))
        mallory.start()
        told: list[str] = []
        report = threading.Thread(target=lambda: told.append(_metrics(tmp_path, server.getsockname()[1])), daemon=True)
        report.start()
        report.join(30.0)
        done.set()
        mallory.join()
    assert len(told) == 1
    assert "time" in told[0]


def _metrics(folder: Path, port: int) -> str:
    path = folder / "sidecar.yaml"
    path.write_text(yaml.safe_dump(ROBOT | {"metrics_listen": f"127.0.0.1:{port}"}))
    return bugreport._metrics(Examination(config=load_config(path)))
