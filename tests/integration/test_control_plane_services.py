"""What a control plane serves beside its streams: health, reflection, STUN, metrics, status."""

from __future__ import annotations

import json
import re
import socket
import subprocess
import sys
import time
import urllib.request
from ipaddress import ip_address

import grpc
import pytest
from grpc_health.v1 import health_pb2, health_pb2_grpc
from grpc_reflection.v1alpha import reflection_pb2, reflection_pb2_grpc

from plr.protos.model.mapping import MappingSet
from plr.protos.model.members import PeerSet
from plr.protos.model.report import OutcomeReport, Report
from plr.protos.model.status import SyncState
from plr.protos.model.stream import Heartbeat
from plr.protos.stun.codec import MessageClass, StunMessage, decode, encode
from tests.support.control_plane_process import PATIENCE_S, ControlPlaneProcess, cloud, robot
from tests.support.samples import PLAN, histogram, path


def test_health_and_reflection(plane: ControlPlaneProcess) -> None:
    with grpc.insecure_channel(plane.address) as channel:
        health = health_pb2_grpc.HealthStub(channel)
        for service in ("", "plr.v1.ControlPlane", "plr.v1.Admin"):
            answer = health.Check(health_pb2.HealthCheckRequest(service=service), timeout=PATIENCE_S)
            assert answer.status == health_pb2.HealthCheckResponse.SERVING
        reflection = reflection_pb2_grpc.ServerReflectionStub(channel)
        requests = iter([reflection_pb2.ServerReflectionRequest(list_services="")])
        (listed,) = reflection.ServerReflectionInfo(requests, timeout=PATIENCE_S)
        names = {service.name for service in listed.list_services_response.service}
        assert {"plr.v1.ControlPlane", "plr.v1.Admin", "grpc.health.v1.Health"} <= names


def test_stun_is_answered(plane: ControlPlaneProcess) -> None:
    host, port = plane.stun.rsplit(":", 1)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.bind(("127.0.0.1", 0))
        sock.settimeout(PATIENCE_S)
        sock.sendto(encode(StunMessage(MessageClass.REQUEST, bytes(range(12)))), (host, int(port)))
        answer = decode(sock.recv(2048))
        assert answer.message_class is MessageClass.SUCCESS
        assert answer.xor_mapped_address == sock.getsockname()


def metrics_text(plane: ControlPlaneProcess) -> str:
    with urllib.request.urlopen(f"http://{plane.metrics}/metrics", timeout=PATIENCE_S) as answer:
        return str(answer.read().decode())


def test_metrics_of_the_contract_are_there_and_promtool_finds_nothing(plane: ControlPlaneProcess) -> None:
    with cloud(plane.address, "cloud-a"), robot(plane.address, "measured") as r:
        r.peers("cloud-a")
        nacked = r.expect(MappingSet, lambda message: bool(message.services[0].assignments))
        r.nack(nacked, "no")
        r.send(Report(outcomes=(OutcomeReport(PLAN, ok=3, deadline_missed=1),)))
        patterns = {
            r'plr_connected_sidecars\{role="robot"\} 1\.0',
            r'plr_nacks_total\{resource="mapping"\} [1-9]',
            r'plr_observed_miss_ratio\{robot="measured",service="/plan"\} 0\.25',
            r'plr_predicted_miss_probability\{robot="measured",service="/plan"\} 0\.',
            r'plr_resource_sync\{resource="mapping",state="rejected"\} 1\.0',
            r"plr_plan_excess_interfaces 1\.0",
            r"plr_solve_duration_seconds_count [1-9]",
        }
        end = time.monotonic() + PATIENCE_S
        missing = patterns
        while missing and time.monotonic() < end:
            time.sleep(0.1)
            r.send(Heartbeat())
            text = metrics_text(plane)
            missing = {pattern for pattern in patterns if not re.search(pattern, text)}
        assert not missing
    checked = subprocess.run(["promtool", "check", "metrics"], input=text, capture_output=True, text=True, check=False)
    assert checked.returncode == 0, checked.stderr
    assert checked.stdout + checked.stderr == ""
    assert "_created" not in text


@pytest.mark.audit("dp-12")
def test_status_as_a_table_and_as_json(plane: ControlPlaneProcess) -> None:
    with cloud(plane.address, "cloud-a"), robot(plane.address) as r:
        r.nack(r.expect(PeerSet, lambda message: bool(message.peers)), "not\nthis\tone")
        plane.wait_for_state("robot", SyncState.REJECTED)
        table = subprocess.run(
            [sys.executable, "-m", "plr.controlplane.cli", "status", "--insecure", "--address", plane.address],
            capture_output=True,
            text=True,
            check=True,
        ).stdout
        as_json = subprocess.run(
            [
                sys.executable,
                "-m",
                "plr.controlplane.cli",
                "status",
                "--insecure",
                "--address",
                plane.address,
                "--json",
            ],
            capture_output=True,
            text=True,
            check=True,
        ).stdout
    assert re.search(r"^robot +robot +open .* rejected ", table, re.MULTILINE)
    assert "not this one" in table
    assert '"SYNC_STATE_REJECTED"' in as_json
    addresses = [
        candidate["address"]["ip"]
        for sidecar in json.loads(as_json)["sidecars"]
        for candidate in sidecar["peer"].get("candidates", [])
    ]
    assert addresses
    assert all(ip_address(address) for address in addresses), "as people write them, not base64"


@pytest.mark.audit("ops-19")
def test_plr_status_imports_only_what_it_needs(plane: ControlPlaneProcess) -> None:
    """Names, not times: what is imported takes most of the time that the command takes."""
    program = (
        "import sys; from plr.controlplane.cli.__main__ import main;"
        f"code = main(['status', '--insecure', '--address', {plane.address!r}, '--timeout-s', '30']);"
        "print('IMPORTED', *sys.modules); sys.exit(code)"
    )
    with cloud(plane.address, "cloud-a"), robot(plane.address) as r:
        r.expect(PeerSet, lambda message: bool(message.peers))
        r.send(Report(paths=(path("wlan0", "cloud-a", rtt=histogram(0.02)),)))
        until = time.monotonic() + PATIENCE_S
        while not plane.status()["robot"].paths:
            assert time.monotonic() < until
            time.sleep(0.02)
        found = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True).stdout
    text, _, names = found.partition("IMPORTED ")
    assert "wlan0 -> cloud-a" in text
    modules = set(names.split())
    heavy = ("numpy", "pydantic", "yaml", "ortools", "pandas", "matplotlib", "prometheus_client", "grpc_health.v1")
    rest = (
        "grpc_reflection.v1alpha",
        "google.protobuf.json_format",
        "plr.controlplane.ca",
        "plr.controlplane.planning",
    )
    ours = (
        "plr.controlplane.config.controlplane",
        "plr.controlplane.core",
        "plr.controlplane.loop",
    )
    assert modules & {*heavy, *rest, *ours} == set()
    assert {"grpc", "plr.controlplane.cli.status_command"} <= modules
