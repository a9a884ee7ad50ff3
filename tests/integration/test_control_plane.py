"""The control plane as a process, spoken to over real gRPC, UDP and HTTP."""

from __future__ import annotations

import json
import random
import re
import signal
import socket
import subprocess
import sys
import time
import urllib.request
from typing import TYPE_CHECKING

import grpc
import pytest
import yaml
from grpc_health.v1 import health_pb2, health_pb2_grpc
from grpc_reflection.v1alpha import reflection_pb2, reflection_pb2_grpc

from protos.convert import sidecar_message_to_proto, status_from_proto
from protos.model import (
    Ack,
    Drain,
    Heartbeat,
    MappingSet,
    OutcomeReport,
    PeerSet,
    RemovalReason,
    Report,
    ResourceKind,
    Role,
    SyncState,
    Welcome,
)
from protos.plr.v1 import admin_pb2, admin_pb2_grpc, control_pb2
from protos.stun import MessageClass, StunMessage, decode, encode
from tests.integration.control_plane_process import PATIENCE_S, ControlPlaneProcess, Sidecar, Stream, cloud, robot
from tests.unit.controlplane.samples import PLAN, histogram, latency, path, registration

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from protos.model import SidecarStatus


@pytest.fixture(scope="module")
def plane(tmp_path_factory: pytest.TempPathFactory) -> Iterator[ControlPlaneProcess]:
    """One process for all tests that do not end it; each test's sidecars say goodbye to it."""
    with ControlPlaneProcess(tmp_path_factory.mktemp("plane")) as process:
        yield process
        assert process.stop() == 0
        assert not [line for line in process.lines if "Traceback" in line or "ERROR" in line]


@pytest.fixture
def alone(tmp_path: Path) -> Iterator[ControlPlaneProcess]:
    """A process of the test's own, with short leases."""
    with ControlPlaneProcess(tmp_path, lease_ms=2000) as process:
        yield process


def status(plane: ControlPlaneProcess) -> dict[str, SidecarStatus]:
    with grpc.insecure_channel(plane.address) as channel:
        answer = admin_pb2_grpc.AdminStub(channel).GetStatus(admin_pb2.GetStatusRequest(), timeout=PATIENCE_S)
    return {found.peer.name: found for found in status_from_proto(answer)}


def wait_for_state(plane: ControlPlaneProcess, name: str, state: SyncState) -> SidecarStatus:
    """The peers of this sidecar get into this state; an ack is on its way for a moment."""
    end = time.monotonic() + PATIENCE_S
    while time.monotonic() < end:
        found = status(plane).get(name)
        if found is not None and found.peers.state is state:
            return found
        time.sleep(0.02)
    raise AssertionError(f"{name} is {found}")


def test_two_clouds_and_a_robot_get_peers_and_a_mapping(plane: ControlPlaneProcess) -> None:
    address = plane.address
    with cloud(address, "cloud-a") as a, cloud(address, "cloud-b") as b, robot(address) as r:
        welcome = r.expect(Welcome)
        assert (welcome.lease_s, welcome.report_interval_s) == (60.0, 0.1)
        assert welcome.stun_servers == ("192.0.2.1:3478",)
        peers = r.peers("cloud-a", "cloud-b")
        assert peers.peers[0].candidates[0].address == ("10.0.0.1", 4000)
        mapping = r.mapping("cloud-a", "cloud-b")
        assert mapping.version > 0
        a.peers("robot"), b.peers("robot")
        slow = {("wlan0", "cloud-a"): 0.3, ("wwan0", "cloud-b"): 0.3}
        pairs = [(nic, server) for nic in ("wlan0", "wwan0") for server in ("cloud-a", "cloud-b")]
        r.send(
            Report(
                latencies=tuple(latency(*pair, histogram(slow.get(pair, 0.02), times=200)) for pair in pairs),
                paths=tuple(path(*pair) for pair in pairs),
                outcomes=(OutcomeReport(PLAN, ok=98, deadline_missed=2),),
            )
        )
        best = r.expect(
            MappingSet,
            lambda message: (
                {(x.interface, x.server) for service in message.services for x in service.assignments}
                == {("wlan0", "cloud-b"), ("wwan0", "cloud-a")}
                and message.services[0].predicted_miss < 1e-4
            ),
        )
        r.ack(best)
        shown = wait_for_state(plane, "robot", SyncState.SYNCED)
        assert shown.peers.version_acked == peers.version
        assert {(report.interface, report.server) for report in shown.paths} == set(pairs)
        assert shown.services == best.services
        assert shown.peer.token == b""


def test_ack_nack_and_stale_nonces(plane: ControlPlaneProcess) -> None:
    with cloud(plane.address, "cloud-a"), robot(plane.address) as r:
        first = r.expect(PeerSet, lambda message: len(message.peers) == 1)
        assert wait_for_state(plane, "robot", SyncState.STALE).peers.version_sent == first.version
        r.nack(first, "two peers share a session", in_force=7)
        shown = wait_for_state(plane, "robot", SyncState.REJECTED)
        assert shown.peers.error == "two peers share a session"
        assert shown.peers.version_acked == 7
        # An ack does not undo the nack of the same nonce.
        r.ack(first)
        with cloud(plane.address, "cloud-b"):
            second = r.expect(PeerSet)
            assert second.version > first.version
            assert second.nonce > first.nonce
            r.send(Ack(ResourceKind.PEERS, first.version, first.nonce))
            assert wait_for_state(plane, "robot", SyncState.STALE).peers.version_acked == 7
            r.ack(second)
            assert wait_for_state(plane, "robot", SyncState.SYNCED).peers.version_acked == second.version
    plane.wait_for_line("robot refuses its peers", "two peers share a session")


def test_sidecars_that_fall_silent_or_are_killed_disappear(alone: ControlPlaneProcess) -> None:
    with robot(alone.address) as r, cloud(alone.address, "cloud-a") as a, cloud(alone.address, "cloud-b") as b:
        r.peers("cloud-a", "cloud-b")
        b.kill()
        names = {"cloud-a", "cloud-b"}
        removed: dict[str, RemovalReason] = {}
        while names:
            message = r.expect(PeerSet)
            names = {peer.name for peer in message.peers}
            removed |= {peer.name: peer.reason for peer in message.removed}
            r.ack(message)
        assert removed == dict.fromkeys(("cloud-a", "cloud-b"), RemovalReason.LEASE_EXPIRED)
        code, details = a.end()
        assert code is grpc.StatusCode.DEADLINE_EXCEEDED
        assert "lease" in details
        assert r.expect(MappingSet, lambda message: not message.services[0].assignments).services[0].reason


def test_who_says_goodbye_has_left_at_once(plane: ControlPlaneProcess) -> None:
    with cloud(plane.address, "cloud-a") as a, robot(plane.address) as r:
        r.peers("cloud-a")
        a.send(Drain())
        a.half_close()
        assert a.end()[0] is grpc.StatusCode.OK
        gone = r.expect(PeerSet, lambda message: not message.peers)
        assert [(peer.name, peer.reason) for peer in gone.removed] == [("cloud-a", RemovalReason.LEFT)]


def test_a_newer_incarnation_replaces_the_older_stream(plane: ControlPlaneProcess) -> None:
    with cloud(plane.address, "cloud-a", incarnation=1) as old, robot(plane.address) as r:
        r.peers("cloud-a")
        with cloud(plane.address, "cloud-a", incarnation=2):
            code, details = old.end()
            assert code is grpc.StatusCode.ABORTED
            assert "newer stream" in details
            newer = r.expect(PeerSet, lambda message: message.peers[0].incarnation == 2)
            assert newer.removed == ()
            with Stream(plane.address) as late:
                late.send(registration("cloud-a", Role.CLOUD, incarnation=1))
                assert late.end()[0] is grpc.StatusCode.ABORTED


def test_a_name_in_use_by_another_is_refused(plane: ControlPlaneProcess) -> None:
    with cloud(plane.address, "cloud-a") as a, Stream(plane.address) as thief:
        a.expect(Welcome)
        thief.send(registration("cloud-a", Role.CLOUD, incarnation=9, token=b"another sidecar!"))
        assert thief.end()[0] is grpc.StatusCode.ALREADY_EXISTS


def raw_register(**changes: object) -> control_pb2.SidecarMessage:
    message = sidecar_message_to_proto(registration("robot"))
    for key, value in changes.items():
        setattr(message.register, key, value)
    return message


@pytest.mark.parametrize(
    ("message", "code", "details"),
    [
        (raw_register(protocol_version=1), grpc.StatusCode.FAILED_PRECONDITION, "protocol version 1 is not 2"),
        (raw_register(protocol_version=99, name="\x00"), grpc.StatusCode.FAILED_PRECONDITION, "protocol version 99"),
        (raw_register(name="no spaces, please"), grpc.StatusCode.INVALID_ARGUMENT, "name 'no spaces, please' is not"),
        (raw_register(name="../../etc"), grpc.StatusCode.INVALID_ARGUMENT, "name"),
        (raw_register(token=b"short"), grpc.StatusCode.INVALID_ARGUMENT, "token has 5 bytes, not 16"),
        (raw_register(session=0), grpc.StatusCode.INVALID_ARGUMENT, "session is 0"),
        (control_pb2.SidecarMessage(), grpc.StatusCode.INVALID_ARGUMENT, "no known kind"),
        (
            control_pb2.SidecarMessage(heartbeat=control_pb2.Heartbeat()),
            grpc.StatusCode.INVALID_ARGUMENT,
            "the first message has to be a registration",
        ),
    ],
)
def test_bad_registrations_get_a_clear_status(
    plane: ControlPlaneProcess, message: control_pb2.SidecarMessage, code: grpc.StatusCode, details: str
) -> None:
    with Stream(plane.address) as stream:
        stream.send_raw(message)
        found, text = stream.end()
        assert found is code
        assert details in text


def test_garbage_after_a_good_registration_ends_that_stream_only(alone: ControlPlaneProcess) -> None:
    with cloud(alone.address, "cloud-g") as good, cloud(alone.address, "cloud-bad") as bad:
        good.expect(Welcome), bad.expect(Welcome)
        bad.send_raw(control_pb2.SidecarMessage(ack=control_pb2.Ack(version=1)))
        code, text = bad.end()
        assert code is grpc.StatusCode.INVALID_ARGUMENT
        assert "resource has no meaning for the value 0" in text
        with Sidecar(alone.address, registration("twice")) as twice:
            twice.send(registration("twice"))
            code, text = twice.end()
            assert code is grpc.StatusCode.INVALID_ARGUMENT
            assert "second registration" in text
        alone.wait_for_line("ended: invalid_argument: resource has no meaning")
        assert good.quiet_for(0.1) or status(alone)["cloud-g"].connected


def test_bytes_that_are_no_message_get_a_clear_status(plane: ControlPlaneProcess) -> None:
    rng = random.Random(4)
    with grpc.insecure_channel(plane.address) as channel:
        connect: grpc.StreamStreamMultiCallable[bytes, bytes] = channel.stream_stream("/plr.v1.ControlPlane/Connect")
        for data in (b"\xff", b"\x0a\x7f", rng.randbytes(200), b""):
            call = connect(iter([data]), timeout=PATIENCE_S)
            with pytest.raises(grpc.RpcError):
                list(call)
            assert call.code() is grpc.StatusCode.INVALID_ARGUMENT


def test_a_stream_that_ends_before_it_registers_is_no_error(plane: ControlPlaneProcess) -> None:
    with Stream(plane.address) as stream:
        stream.half_close()
        assert stream.end()[0] is grpc.StatusCode.OK


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


def test_systemd_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as notified:
        notified.bind(str(tmp_path / "notify"))
        notified.settimeout(PATIENCE_S)
        monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "notify"))
        with ControlPlaneProcess(tmp_path) as plane:
            assert notified.recv(100) == b"READY=1"
            assert plane.stop() == 0
            assert notified.recv(100) == b"STOPPING=1"


def test_after_a_restart_versions_grow_and_robots_keep_their_peers_meanwhile(tmp_path: Path) -> None:
    with ControlPlaneProcess(tmp_path) as plane:
        with cloud(plane.address, "cloud-a"), cloud(plane.address, "cloud-b"), robot(plane.address) as r:
            peers = r.peers("cloud-a", "cloud-b")
            mapping = r.mapping("cloud-a", "cloud-b")
            assert plane.stop(signal.SIGKILL) != 0
    with ControlPlaneProcess(tmp_path, warm_up_ms=60_000) as plane:
        with robot(plane.address, held=max(peers.version, mapping.version)) as r:
            r.expect(Welcome)
            known = tuple(path(nic, server) for nic in ("wlan0", "wwan0") for server in ("cloud-a", "cloud-b"))
            r.send(Report(paths=known))
            with cloud(plane.address, "cloud-b"):
                # One of two is back: a set without the other would take it from the robot.
                assert r.quiet_for(1.0)
                with cloud(plane.address, "cloud-a"):
                    again = r.peers("cloud-a", "cloud-b")
                    assert again.version > peers.version
                    assert r.mapping("cloud-a", "cloud-b").version > mapping.version


def test_a_sidecar_that_holds_more_than_the_clock_gives_is_outgrown(plane: ControlPlaneProcess) -> None:
    far = 1 << 62
    with cloud(plane.address, "cloud-far", held=far) as c:
        assert c.expect(PeerSet).version == far + 1


def test_status_as_a_table_and_as_json(plane: ControlPlaneProcess) -> None:
    with cloud(plane.address, "cloud-a"), robot(plane.address) as r:
        r.nack(r.expect(PeerSet, lambda message: bool(message.peers)), "not\nthis\tone")
        wait_for_state(plane, "robot", SyncState.REJECTED)
        table = subprocess.run(
            [sys.executable, "-m", "controlplane.cli", "status", "--insecure", "--address", plane.address],
            capture_output=True,
            text=True,
            check=True,
        ).stdout
        as_json = subprocess.run(
            [sys.executable, "-m", "controlplane.cli", "status", "--insecure", "--address", plane.address, "--json"],
            capture_output=True,
            text=True,
            check=True,
        ).stdout
    assert re.search(r"^robot +robot +open .* rejected ", table, re.MULTILINE)
    assert "not this one" in table
    assert '"SYNC_STATE_REJECTED"' in as_json


def run(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "controlplane", *arguments], capture_output=True, text=True, check=False
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
    assert re.fullmatch(r"plr-controlplane \S+ \(protocol 2\)\n", run("--version").stdout)
    assert run().returncode == 2


def test_insecure_mode_is_refused_where_others_reach_it_unless_one_knows(tmp_path: Path) -> None:
    config = tmp_path / "exposed.yaml"
    config.write_text("insecure: true\n")
    done = run("--config", str(config), "--check-config")
    assert done.returncode == 2
    assert done.stderr.startswith(f"plr-controlplane: {config}: listen: expected a loopback address with insecure")
    assert run("--config", str(config), "--check-config", "--insecure-i-know").returncode == 0


def test_without_certificates_and_without_the_word_insecure_it_does_not_start(tmp_path: Path) -> None:
    config = tmp_path / "neither.yaml"
    cases = {"": "tls_dir: expected the folder", "insecure: true\ntls_dir: /etc/plr/tls": "one or the other"}
    for text, told in cases.items():
        config.write_text(text)
        done = run("--config", str(config))
        assert done.returncode == 2
        assert told in done.stderr
        assert done.stderr.count("\n") == 1


@pytest.mark.parametrize(
    ("key", "kind"),
    [("listen", socket.SOCK_STREAM), ("stun_listen", socket.SOCK_DGRAM), ("metrics_listen", socket.SOCK_STREAM)],
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


def test_the_schema_is_printed() -> None:
    done = subprocess.run(
        [sys.executable, "-m", "controlplane.cli", "config", "schema", "controlplane"],
        capture_output=True,
        text=True,
        check=True,
    )
    assert "lease_ms" in json.loads(done.stdout)["properties"]
