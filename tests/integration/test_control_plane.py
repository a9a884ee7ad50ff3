"""Sidecars come, learn of each other, and go: a real control plane over real gRPC."""

from __future__ import annotations

import signal
from typing import TYPE_CHECKING

import grpc
import pytest

from plr.controlplane.core.publish.snapshots import MAX_LIFTED
from plr.protos.model.ids import Role
from plr.protos.model.mapping import MappingSet
from plr.protos.model.members import PeerSet, RemovalReason
from plr.protos.model.report import OutcomeReport, Report
from plr.protos.model.status import SyncState
from plr.protos.model.stream import Ack, Drain, ResourceKind, Welcome
from tests.support.control_plane_process import ControlPlaneProcess, Stream, cloud, robot
from tests.support.samples import PLAN, histogram, latency, path, registration

if TYPE_CHECKING:
    from pathlib import Path


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
        shown = plane.wait_for_state("robot", SyncState.SYNCED)
        assert shown.peers.version_acked == peers.version
        assert {(report.interface, report.server) for report in shown.paths} == set(pairs)
        assert shown.services == best.services
        assert shown.peer.token == b""


def test_ack_nack_and_stale_nonces(plane: ControlPlaneProcess) -> None:
    with cloud(plane.address, "cloud-a"), robot(plane.address) as r:
        first = r.expect(PeerSet, lambda message: len(message.peers) == 1)
        assert plane.wait_for_state("robot", SyncState.STALE).peers.version_sent == first.version
        r.nack(first, "two peers share a session", in_force=7)
        shown = plane.wait_for_state("robot", SyncState.REJECTED)
        assert shown.peers.error == "two peers share a session"
        assert shown.peers.version_acked == 7
        # An ack does not undo the nack of the same nonce.
        r.ack(first)
        with cloud(plane.address, "cloud-b"):
            second = r.expect(PeerSet)
            assert second.version > first.version
            assert second.nonce > first.nonce
            r.send(Ack(ResourceKind.PEERS, first.version, first.nonce))
            assert plane.wait_for_state("robot", SyncState.STALE).peers.version_acked == 7
            r.ack(second)
            assert plane.wait_for_state("robot", SyncState.SYNCED).peers.version_acked == second.version
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
                    # As every robot does with new peers: who was not back when it reported first is believed in now.
                    r.send(Report(paths=known))
                    assert r.mapping("cloud-a", "cloud-b").version > mapping.version


def test_a_sidecar_that_holds_more_than_the_clock_gives_is_outgrown(plane: ControlPlaneProcess) -> None:
    far = MAX_LIFTED - 1000  # the tests after this one lift it further
    with cloud(plane.address, "cloud-far", held=far) as c:
        assert c.expect(PeerSet).version == far + 1


@pytest.mark.audit("ops-17")
def test_a_sidecar_that_holds_what_no_control_plane_gave_out_starts_over(plane: ControlPlaneProcess) -> None:
    with cloud(plane.address, "cloud-far", held=1 << 62) as c:
        assert c.expect(PeerSet).version < MAX_LIFTED
