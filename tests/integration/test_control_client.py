"""ControlClient against a real gRPC server."""

from __future__ import annotations

import asyncio
import logging
import os
import queue
import random
import signal
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import TYPE_CHECKING

import grpc
import pytest

from plr.protos.model.ids import (
    PROTOCOL_VERSION,
    InterfaceId,
    InterfaceName,
    NodeName,
    Role,
    ServiceName,
    SessionId,
    Version,
)
from plr.protos.model.mapping import MappingSet
from plr.protos.model.members import (
    Candidate,
    CandidateKind,
    CandidateSet,
    PeerSet,
    Registration,
    ServiceOffer,
    ServiceSet,
)
from plr.protos.model.report import OutcomeReport, Report
from plr.protos.model.stream import Ack, Drain, Heartbeat, Nack, ResourceKind, Welcome
from plr.protos.plr.v1 import control_pb2
from plr.sidecar.control import client
from plr.sidecar.control.client import ControlClient
from plr.sidecar.core.control import session as control_session
from plr.sidecar.core.control.session import ControlSession
from plr.sidecar.net.control_dialer import ControlDialer
from tests.integration.scripted_control_plane import END, WAIT_S, ScriptedControlPlane
from tests.support.free_ports import free_port

if TYPE_CHECKING:
    from collections.abc import Iterator

    from plr.protos.program.tls_files import TlsFiles
    from plr.sidecar.core.base.report_scope import ReportScope

WELCOME = Welcome(lease_s=0.6, report_interval_s=0.1, stun_servers=("192.0.2.9:3478",))
CANDIDATE = Candidate(InterfaceId(0), InterfaceName("wlan0"), CandidateKind.HOST, ("192.0.2.2", 9))
OFFER = ServiceOffer(ServiceName("/plan"), "nav_msgs/srv/GetPlan")


class Recorder:
    """A data plane and hooks that note what they are told."""

    def __init__(self) -> None:
        self.welcomes: list[Welcome] = []
        self.in_force: list[PeerSet | MappingSet] = []
        self.connection: queue.Queue[tuple[bool, str]] = queue.Queue()
        self.report = Report()
        self.error: str | None = None
        self.crash = False
        self.judgements = 0

    def welcome(self, welcome: Welcome) -> None:
        self.welcomes.append(welcome)

    def apply_peers(self, peer_set: PeerSet) -> str | None:
        if self.crash:
            raise RuntimeError("broken engine")
        return self.error

    def apply_mapping(self, mapping: MappingSet) -> str | None:
        return self.apply_peers(PeerSet(mapping.version, mapping.nonce))

    def applied(self, content: PeerSet | MappingSet) -> None:
        self.in_force.append(content)

    def take_report(self, scope: ReportScope) -> Report:
        if self.crash:
            raise RuntimeError("broken engine")
        return self.report

    def certificate_changed(self, files: TlsFiles) -> None:
        raise AssertionError("insecure here")

    def look_at_revocations(self) -> None:
        pass

    def end_expired(self) -> None:
        pass

    def judge_again(self) -> None:
        self.judgements += 1
        if self.crash:
            raise RuntimeError("broken engine")

    def connection_changed(self, connected: bool, reason: str) -> None:
        self.connection.put((connected, reason))

    def expect_connection(self, connected: bool) -> str:
        now_connected, reason = self.connection.get(timeout=WAIT_S)
        assert now_connected is connected
        return reason


class Rig:
    def __init__(self, *targets: str, held: int = 0) -> None:
        registration = Registration(
            PROTOCOL_VERSION,
            NodeName("robot-1"),
            Role.ROBOT,
            SessionId(7),
            bytes(range(16)),
            incarnation=3,
            software_version="0.1.0",
            peers_version=Version(held),
        )
        self.hooks = Recorder()
        session = ControlSession(registration, random.Random(1))
        self.client = ControlClient(ControlDialer(targets, session.stats), session, self.hooks, self.hooks)


@pytest.fixture
def server() -> Iterator[ScriptedControlPlane]:
    with ScriptedControlPlane(welcome=WELCOME) as server:
        yield server


@pytest.fixture
def rig(server: ScriptedControlPlane) -> Iterator[Rig]:
    rig = Rig(server.target, held=40)
    yield rig
    rig.client.stop()
    assert "plr-control" not in {thread.name for thread in threading.enumerate()}


def test_registers_with_what_it_holds_then_says_everything(server: ScriptedControlPlane, rig: Rig) -> None:
    rig.client.set_candidates(CandidateSet((CANDIDATE,)))
    rig.client.start()
    registration = server.expect(Registration)
    assert registration.name == "robot-1"
    assert registration.token == bytes(range(16))
    assert (registration.peers_version, registration.mapping_version) == (40, 0)
    assert server.heard.get(timeout=WAIT_S) == CandidateSet((CANDIDATE,))
    assert server.heard.get(timeout=WAIT_S) == ServiceSet()
    rig.hooks.expect_connection(True)
    assert rig.client.connected
    assert rig.hooks.welcomes == [WELCOME]
    rig.client.set_services(ServiceSet((OFFER,), ()))
    assert server.expect(ServiceSet) == ServiceSet(offers=(OFFER,))


def test_applies_and_acks(server: ScriptedControlPlane, rig: Rig) -> None:
    rig.client.start()
    rig.hooks.expect_connection(True)
    server.say(PeerSet(Version(41), nonce=5))
    assert server.expect(Ack) == Ack(ResourceKind.PEERS, Version(41), 5)
    server.say(MappingSet(Version(7), nonce=6))
    assert server.expect(Ack) == Ack(ResourceKind.MAPPING, Version(7), 6)
    assert [content.version for content in rig.hooks.in_force] == [41, 7]


def test_what_the_engine_refuses_is_nacked(
    server: ScriptedControlPlane, rig: Rig, caplog: pytest.LogCaptureFixture
) -> None:
    rig.hooks.error = "/plan: no interface 'wwan7' here"
    rig.client.start()
    rig.hooks.expect_connection(True)
    for version, nonce in ((41, 5), (42, 6)):
        server.say(PeerSet(Version(version), nonce=nonce))
        assert server.expect(Nack) == Nack(ResourceKind.PEERS, Version(40), nonce, rig.hooks.error)
    told = [record for record in caplog.records if record.getMessage().startswith("refused peers")]
    assert len(told) == 1, "sent again until it is taken: told once"
    rig.hooks.error = None
    server.say(PeerSet(Version(43), nonce=7))
    assert server.expect(Ack) == Ack(ResourceKind.PEERS, Version(43), 7)


def test_a_refused_mapping_is_tried_again_when_the_sidecar_has_news(server: ScriptedControlPlane, rig: Rig) -> None:
    rig.hooks.error = "/plan: no interface 'wwan7' here"
    rig.client.start()
    rig.hooks.expect_connection(True)
    server.say(MappingSet(Version(7), nonce=5))
    assert server.expect(Nack).nonce == 5
    rig.client.try_again()
    server.say(MappingSet(Version(8), nonce=6))
    assert server.expect(Nack).nonce == 6, "what fails again is not said again"
    rig.hooks.error = None
    rig.client.try_again()
    wait_for(lambda: rig.hooks.in_force)
    server.say(MappingSet(Version(9), nonce=7))
    assert server.expect(Ack) == Ack(ResourceKind.MAPPING, Version(9), 7)
    rig.client.try_again()
    server.say(PeerSet(Version(41), nonce=8))
    server.expect(Ack)
    assert [content.version for content in rig.hooks.in_force] == [8, 9, 41], "the newest only, and once"


def test_a_crash_of_the_engine_becomes_a_nack_and_the_stream_goes_on(server: ScriptedControlPlane, rig: Rig) -> None:
    rig.hooks.crash = True
    rig.client.start()
    rig.hooks.expect_connection(True)
    server.say(PeerSet(Version(41), nonce=5))
    assert "broken engine" in server.expect(Nack).error
    server.expect(Heartbeat)
    assert server.expect(Heartbeat) == Heartbeat()


def test_a_malformed_push_is_nacked_by_its_nonce(server: ScriptedControlPlane, rig: Rig) -> None:
    rig.client.start()
    rig.hooks.expect_connection(True)
    broken = control_pb2.PeerSet(version=41, nonce=5)
    broken.peers.add(name="no spaces allowed")
    server.say_raw(control_pb2.ControlMessage(peers=broken))
    nack = server.expect(Nack)
    assert (nack.resource, nack.version, nack.nonce) == (ResourceKind.PEERS, 40, 5)
    assert nack.error
    server.say_raw(control_pb2.ControlMessage())
    server.say(PeerSet(Version(42), nonce=6))
    assert server.expect(Ack).nonce == 6
    assert rig.client.stats.ignored["undecodable"] == 2


@pytest.mark.audit("ops-10")
def test_what_a_newer_control_plane_says_is_left_out(
    server: ScriptedControlPlane, rig: Rig, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    rig.client.start()
    rig.hooks.expect_connection(True)
    for _ in range(2):
        server.say_raw(control_pb2.ControlMessage.FromString(b"\xaa\x06\x02hi"))  # field 101
    server.say(PeerSet(Version(41), nonce=9))
    assert server.expect(Ack) == Ack(ResourceKind.PEERS, Version(41), 9)
    assert rig.client.stats.ignored == {"unknown_kind": 2}
    assert sum("left out" in message for message in caplog.messages) == 1


def test_sends_reports_while_there_is_something_to_report(server: ScriptedControlPlane, rig: Rig) -> None:
    rig.hooks.report = Report(outcomes=(OutcomeReport(ServiceName("/plan"), ok=3),))
    rig.client.start()
    for _ in range(3):
        assert server.expect(Report) == rig.hooks.report
    rig.hooks.report = Report()
    assert server.expect(Heartbeat) == Heartbeat()


def test_comes_back_after_the_stream_is_closed(server: ScriptedControlPlane, rig: Rig) -> None:
    rig.client.start()
    rig.hooks.expect_connection(True)
    server.say(PeerSet(Version(50), nonce=1))
    server.expect(Ack)
    server.close_stream()
    assert "closed by the control plane" in rig.hooks.expect_connection(False)
    rig.hooks.expect_connection(True)
    assert server.expect(Registration).peers_version == 50


def test_comes_back_after_an_outage_at_the_same_address() -> None:
    port = free_port()
    rig = Rig(f"127.0.0.1:{port}")
    rig.client.start()
    try:
        for _ in range(2):
            with ScriptedControlPlane(port, welcome=WELCOME) as server:
                server.expect(Registration)
                rig.hooks.expect_connection(True)
            assert rig.hooks.expect_connection(False)
    finally:
        rig.client.stop()


SERVER_TO_KILL = """
import sys, time
from plr.protos.model.stream import Welcome
from tests.integration.scripted_control_plane import ScriptedControlPlane
with ScriptedControlPlane(int(sys.argv[1]), welcome=Welcome(lease_s=3.0, report_interval_s=0.5)) as server:
    sys.stdin.read()
"""


@pytest.mark.audit("ops-1")
def test_comes_back_with_the_python_of_debian_12(monkeypatch: pytest.MonkeyPatch) -> None:
    """Until 3.11.3 `asyncio.timeout` took every cancellation counted in its task for one that is wanted now."""
    entered = asyncio.Timeout.__aenter__

    async def enter(entering: asyncio.Timeout) -> asyncio.Timeout:
        await entered(entering)
        vars(entering)["_cancelling"] = 0  # as 3.11.2 compares: with nothing, not with what was counted before
        return entering

    monkeypatch.setattr(asyncio.Timeout, "__aenter__", enter)
    port = free_port()
    rig = Rig(f"127.0.0.1:{port}")
    rig.client.start()
    deadline = time.monotonic() + WAIT_S
    while rig.client.stats.attempts < 3:
        assert time.monotonic() < deadline, "no attempt follows the first that failed"
        time.sleep(0.01)
    with ScriptedControlPlane(port, welcome=WELCOME):
        rig.hooks.expect_connection(True)
    rig.client.stop()


def test_notices_a_killed_control_plane_and_finds_its_successor() -> None:
    port = free_port()
    root = Path(__file__).parents[2]
    rig = Rig(f"127.0.0.1:{port}")
    rig.client.start()
    try:
        for _ in range(2):
            argv = [sys.executable, "-c", SERVER_TO_KILL, str(port)]
            with subprocess.Popen(argv, stdin=subprocess.PIPE, cwd=root) as process:
                rig.hooks.expect_connection(True)
                process.send_signal(signal.SIGKILL)
            assert "UNAVAILABLE" in rig.hooks.expect_connection(False)
    finally:
        rig.client.stop()


@pytest.mark.parametrize("code", [grpc.StatusCode.FAILED_PRECONDITION, grpc.StatusCode.CANCELLED])
def test_a_refusal_is_logged_with_its_reason_and_tried_again(
    server: ScriptedControlPlane, rig: Rig, code: grpc.StatusCode, caplog: pytest.LogCaptureFixture
) -> None:
    server.refusal = (code, "protocol version 1, this control plane speaks 2")
    with caplog.at_level(logging.WARNING):
        rig.client.start()
        server.expect(Registration)
        server.expect(str)
        wait_for(lambda: "this control plane speaks 2" in caplog.text)
    assert not rig.client.connected
    server.refusal = None
    rig.hooks.expect_connection(True)


def test_gives_up_a_stream_that_is_never_answered(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(control_session, "WELCOME_TIMEOUT_S", 0.3)
    with socket.create_server(("127.0.0.1", 0)) as deaf, caplog.at_level(logging.WARNING):
        rig = Rig(f"127.0.0.1:{deaf.getsockname()[1]}")
        rig.client.start()
        wait_for(lambda: "no answer to the registration" in caplog.text)
        wait_for(lambda: rig.client.stats.attempts >= 2)
        rig.client.stop()
    assert rig.client.stats.streams == 0


@pytest.mark.audit("dp-12")
def test_leaves_an_address_that_takes_connections_and_says_nothing_to_the_others(
    server: ScriptedControlPlane, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The kernel goes on accepting for a control plane that hangs; a hotspot's portal does the same."""
    monkeypatch.setattr(control_session, "WELCOME_TIMEOUT_S", 0.5)
    with socket.create_server(("127.0.0.1", 0)) as deaf:
        rig = Rig(f"127.0.0.1:{deaf.getsockname()[1]}", server.target)
        rig.client.start()
        wait_for(lambda: rig.client.stats.streams or rig.client.stats.attempts >= 5)
        rig.client.stop()
    assert (rig.client.stats.streams, rig.client.stats.attempts) == (1, 2)


def test_judges_again_and_again_also_without_control_plane_and_whatever_comes_of_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(client, "JUDGE_AGAIN_S", 0.01)
    rig = Rig(f"127.0.0.1:{free_port()}")
    rig.hooks.crash = True
    rig.client.start()
    wait_for(lambda: rig.hooks.judgements >= 3)
    rig.client.stop()


@pytest.mark.parametrize("target", ["127.0.0.1:{port}", "no-such-host.invalid:50051"])
def test_an_unreachable_control_plane_blocks_nobody(target: str, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING):
        rig = Rig(target.format(port=free_port()))
        rig.client.start()
        rig.client.set_candidates(CandidateSet((CANDIDATE,)))
        rig.client.set_services(ServiceSet((), ()))
        wait_for(lambda: rig.client.stats.attempts >= 2)
        wait_for(lambda: "the sidecar continues without it" in caplog.text)
        rig.client.stop()
    assert rig.hooks.connection.empty()
    assert "plr-control" not in {thread.name for thread in threading.enumerate()}


def test_stop_says_goodbye_last(server: ScriptedControlPlane, rig: Rig) -> None:
    rig.client.start()
    rig.hooks.expect_connection(True)
    rig.client.stop()
    heard = [server.heard.get(timeout=WAIT_S)]
    while heard[-1] != END:
        heard.append(server.heard.get(timeout=WAIT_S))
    assert heard[-2] == Drain()
    assert rig.hooks.expect_connection(False) == "stopped"
    rig.client.stop()
    rig.client.set_candidates(CandidateSet((CANDIDATE,)))


def test_a_drained_sidecar_stays_connected(server: ScriptedControlPlane, rig: Rig) -> None:
    rig.client.start()
    rig.hooks.expect_connection(True)
    rig.client.drain()
    server.expect(Drain)
    server.expect(Heartbeat)
    assert rig.client.connected


def test_stop_before_start_is_harmless() -> None:
    Rig("127.0.0.1:1").client.stop()


def test_environment_proxies_are_not_used(
    server: ScriptedControlPlane, rig: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(os.environ, "http_proxy", "http://127.0.0.1:1")
    monkeypatch.setitem(os.environ, "no_grpc_proxy", "example.org")
    monkeypatch.delenv("no_proxy", raising=False)
    rig.client.start()
    rig.hooks.expect_connection(True)


def wait_for(condition: object) -> None:
    assert callable(condition)
    end = time.monotonic() + WAIT_S
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.01)
