"""ControlClient and plr-controlplane together: what one says, the other understands."""

from __future__ import annotations

import contextlib
import os
import queue
import random
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING

import yaml

from plr.protos.base.histogram import Histogram
from plr.protos.model.ids import PROTOCOL_VERSION, InterfaceId, InterfaceName, NodeName, Role, ServiceName, SessionId
from plr.protos.model.mapping import Assignment, MappingSet
from plr.protos.model.members import (
    Candidate,
    CandidateKind,
    CandidateSet,
    PeerSet,
    Registration,
    ServiceOffer,
    ServiceSet,
    ServiceUse,
)
from plr.protos.model.report import PathReport, Report
from plr.protos.model.stream import ResourceKind, Welcome
from plr.protos.trust.pair_token import pair_token
from plr.sidecar.control.client import ControlClient
from plr.sidecar.core.control import session
from plr.sidecar.core.control.session import ControlSession
from plr.sidecar.net.control_dialer import ControlDialer
from tests.integration.scripted_control_plane import WAIT_S
from tests.support.free_ports import free_port

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    import pytest

    from plr.protos.program.tls_files import TlsFiles
    from plr.sidecar.core.base.report_scope import ReportScope

ROOT = Path(__file__).parents[2]
PLAN = ServiceName("/plan_path")
GET_PLAN = "nav_msgs/srv/GetPlan"


class ControlPlane:
    """plr-controlplane as a process, which can be killed and started again at the same port."""

    def __init__(self, folder: Path) -> None:
        self.port = free_port()
        self._path = folder / "controlplane.yaml"
        settings: dict[str, object] = {
            "insecure": True,
            "listen": f"127.0.0.1:{self.port}",
            "stun_listen": [],
            "metrics_listen": None,
            "lease_ms": 1500,
            "report_interval_ms": 100,
            "warm_up_ms": 500,
        }
        self._path.write_text(yaml.safe_dump(settings))

    @contextlib.contextmanager
    def running(self) -> Iterator[None]:
        argv = [sys.executable, "-m", "plr.controlplane", "--config", str(self._path)]
        with subprocess.Popen(argv, env={**os.environ, "PYTHONPATH": str(ROOT)}) as process:
            try:
                self._wait_until_it_listens(process)
                yield
            finally:
                process.send_signal(signal.SIGKILL)

    def _wait_until_it_listens(self, process: subprocess.Popen[bytes]) -> None:
        end = time.monotonic() + WAIT_S
        while True:
            with contextlib.suppress(OSError), socket.create_connection(("127.0.0.1", self.port)):
                return
            assert process.poll() is None
            assert time.monotonic() < end
            time.sleep(0.05)


class Sidecar:
    """A control client that believes everything, or refuses mappings."""

    def __init__(self, port: int, name: str, role: Role, number: int) -> None:
        registration = Registration(
            PROTOCOL_VERSION,
            NodeName(name),
            role,
            SessionId(number),
            bytes([number] * 16),
            incarnation=1,
            software_version="test",
        )
        self.session = ControlSession(registration, random.Random(number))
        self.client = ControlClient(ControlDialer((f"127.0.0.1:{port}",), self.session.stats), self.session, self, self)
        self.peers: queue.Queue[PeerSet] = queue.Queue()
        self.mappings: queue.Queue[MappingSet] = queue.Queue()
        self.connection: queue.Queue[bool] = queue.Queue()
        self.refuse: str | None = None
        self.report = Report()
        address = (f"192.0.2.{number}", 24700)
        candidate = Candidate(InterfaceId(0), InterfaceName("eth0"), CandidateKind.HOST, address)
        self.client.set_candidates(CandidateSet((candidate,)))

    def welcome(self, welcome: Welcome) -> None:
        assert welcome.lease_s == 1.5

    def apply_peers(self, peer_set: PeerSet) -> str | None:
        self.peers.put(peer_set)
        return None

    def apply_mapping(self, mapping: MappingSet) -> str | None:
        self.mappings.put(mapping)
        return self.refuse

    def applied(self, content: PeerSet | MappingSet) -> None:
        """Nothing to remember."""

    def take_report(self, scope: ReportScope) -> Report:
        return self.report

    def certificate_changed(self, files: TlsFiles) -> None:
        raise AssertionError("insecure here")

    def look_at_revocations(self) -> None:
        pass

    def end_expired(self) -> None:
        pass

    def judge_again(self) -> None:
        """Nobody is refused here."""

    def connection_changed(self, connected: bool, reason: str) -> None:
        self.connection.put(connected)

    def expect_peers(self, condition: Callable[[PeerSet], bool]) -> PeerSet:
        while True:
            peers = self.peers.get(timeout=WAIT_S)
            if condition(peers):
                return peers

    def expect_mapping_to(self, server: str) -> MappingSet:
        wanted = (Assignment(InterfaceName("eth0"), NodeName(server)),)
        while True:
            mapping = self.mappings.get(timeout=WAIT_S)
            if any(service.assignments == wanted for service in mapping.services):
                return mapping


def names(peers: PeerSet) -> set[str]:
    return {peer.name for peer in peers.peers}


def measured(*servers: str) -> Report:
    rtt = Histogram()
    rtt.record(0.02)
    paths = [PathReport(InterfaceName("eth0"), NodeName(server), True, rtt.copy()) for server in servers]
    return Report(paths=tuple(paths))


@contextlib.contextmanager
def mesh(port: int) -> Iterator[tuple[Sidecar, Sidecar]]:
    """A robot that uses the service which a cloud offers."""
    robot = Sidecar(port, "robot-1", Role.ROBOT, 1)
    cloud = Sidecar(port, "cloud-a", Role.CLOUD, 2)
    cloud.client.set_services(ServiceSet((ServiceOffer(PLAN, GET_PLAN),), ()))
    robot.client.set_services(ServiceSet((), (ServiceUse(PLAN, GET_PLAN, deadline_s=0.1, idempotent=True),)))
    robot.report = measured("cloud-a")
    for sidecar in (cloud, robot):
        sidecar.client.start()
    try:
        yield robot, cloud
    finally:
        for sidecar in (robot, cloud):
            sidecar.client.stop()


def test_sidecars_learn_of_each_other_and_of_their_mapping(tmp_path: Path) -> None:
    control_plane = ControlPlane(tmp_path)
    with control_plane.running(), mesh(control_plane.port) as (robot, cloud):
        seen = robot.expect_peers(lambda peers: names(peers) == {"cloud-a"} and bool(peers.peers[0].offers))
        assert seen.peers[0].candidates[0].address == ("192.0.2.2", 24700)
        assert seen.peers[0].token == pair_token(bytes([2] * 16), NodeName("robot-1"), Role.ROBOT)
        cloud.expect_peers(lambda peers: names(peers) == {"robot-1"})
        mapping = robot.expect_mapping_to("cloud-a")
        assert mapping.services[0].service == PLAN
        # It says goodbye: gone at once, with the reason.
        cloud.client.stop()
        gone = robot.expect_peers(lambda peers: not names(peers))
        assert [removed.name for removed in gone.removed] == ["cloud-a"]


def test_a_refused_mapping_leaves_the_old_version_and_does_not_end_the_stream(tmp_path: Path) -> None:
    control_plane = ControlPlane(tmp_path)
    with control_plane.running(), mesh(control_plane.port) as (robot, _):
        robot.refuse = "no interface 'eth0' here"
        refused = robot.expect_mapping_to("cloud-a")
        assert robot.session.version(ResourceKind.MAPPING) < refused.version
        robot.refuse = None
        second = Sidecar(control_plane.port, "cloud-b", Role.CLOUD, 3)
        second.client.set_services(ServiceSet((ServiceOffer(PLAN, GET_PLAN),), ()))
        second.client.start()
        try:
            robot.expect_peers(lambda peers: names(peers) == {"cloud-a", "cloud-b"})
        finally:
            second.client.stop()
        assert robot.client.stats.streams == 1


def test_a_killed_control_plane_comes_back_with_larger_versions(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(session, "RETRY_MAX_S", 0.5)
    control_plane = ControlPlane(tmp_path)
    with mesh(control_plane.port) as (robot, cloud):
        with control_plane.running():
            before = robot.expect_mapping_to("cloud-a")
            peers_before = robot.session.version(ResourceKind.PEERS)
        for sidecar in (robot, cloud):
            assert sidecar.connection.get(timeout=WAIT_S)
            assert not sidecar.connection.get(timeout=WAIT_S)
        while not robot.mappings.empty():  # it may have said more before it was killed
            before = robot.mappings.get()
        with control_plane.running():
            # A robot that comes back keeps its view; a third sidecar makes the successor push a new one.
            assert robot.connection.get(timeout=WAIT_S)
            third = Sidecar(control_plane.port, "cloud-b", Role.CLOUD, 3)
            third.client.set_services(ServiceSet((ServiceOffer(PLAN, GET_PLAN),), ()))
            third.client.start()
            try:
                peers = robot.expect_peers(lambda peers: names(peers) >= {"cloud-a", "cloud-b"})
                robot.report = measured("cloud-b")
                after = robot.expect_mapping_to("cloud-b")
            finally:
                third.client.stop()
    assert peers.version > peers_before
    assert after.version > before.version
