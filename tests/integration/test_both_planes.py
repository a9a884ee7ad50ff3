"""The sidecar's control client against the real control plane."""

from __future__ import annotations

import queue
import random
import signal
import time
from typing import TYPE_CHECKING

from plr.protos.model.ids import Role
from plr.protos.model.members import CandidateSet, PeerSet, ServiceSet
from plr.protos.model.report import Report
from plr.protos.model.status import SyncState
from plr.sidecar.control.client import ControlClient
from plr.sidecar.core.control.session import ControlSession
from plr.sidecar.net.control_dialer import ControlDialer
from tests.support.control_plane_process import PATIENCE_S, ControlPlaneProcess, cloud
from tests.support.samples import interfaces, path, registration, use

if TYPE_CHECKING:
    from pathlib import Path

    from plr.protos.model.mapping import MappingSet
    from plr.protos.model.stream import Welcome
    from plr.protos.program.tls_files import TlsFiles
    from plr.sidecar.core.base.report_scope import ReportScope


class Engine:
    """Takes whatever the control plane says, and reports every path as up."""

    def __init__(self) -> None:
        self.peers: queue.SimpleQueue[PeerSet] = queue.SimpleQueue()
        self.mappings: queue.SimpleQueue[MappingSet] = queue.SimpleQueue()
        self.known: tuple[str, ...] = ()

    def welcome(self, welcome: Welcome) -> None:
        """Nothing to do."""

    def apply_peers(self, peer_set: PeerSet) -> str | None:
        self.known = tuple(peer.name for peer in peer_set.peers)
        self.peers.put(peer_set)
        return None

    def apply_mapping(self, mapping: MappingSet) -> str | None:
        self.mappings.put(mapping)
        return None

    def applied(self, content: PeerSet | MappingSet) -> None:
        """Nothing to remember."""

    def take_report(self, scope: ReportScope) -> Report:
        return Report(paths=tuple(path(nic, server) for nic in ("wlan0", "wwan0") for server in self.known))

    def certificate_changed(self, files: TlsFiles) -> None:
        raise AssertionError("insecure here")

    def look_at_revocations(self) -> None:
        pass

    def end_expired(self) -> None:
        pass

    def judge_again(self) -> None:
        """Nobody is refused here."""

    def connection_changed(self, connected: bool, reason: str) -> None:
        """Nothing to do."""


def servers_of(mapping: MappingSet) -> set[str]:
    return {assignment.server for assignment in mapping.services[0].assignments}


def test_a_client_registers_follows_and_outlives_a_restart(tmp_path: Path) -> None:
    engine = Engine()
    session = ControlSession(registration("robot", Role.ROBOT), random.Random(1))
    with ControlPlaneProcess(tmp_path, lease_ms=10_000) as plane:
        client = ControlClient(ControlDialer((plane.address,), session.stats), session, engine, engine)
        client.set_candidates(CandidateSet(interfaces("wlan0", "wwan0")))
        client.set_services(ServiceSet((), (use(),)))
        client.start()
        try:
            with cloud(plane.address, "cloud-a"), cloud(plane.address, "cloud-b"):
                while {peer.name for peer in engine.peers.get(timeout=PATIENCE_S).peers} != {"cloud-a", "cloud-b"}:
                    pass
                # One may have come while only one cloud was known.
                while servers_of(engine.mappings.get(timeout=PATIENCE_S)) != {"cloud-a", "cloud-b"}:
                    pass
                end = time.monotonic() + PATIENCE_S
                while (shown := plane.status()["robot"]).mapping.state is not SyncState.SYNCED:
                    assert time.monotonic() < end
                    time.sleep(0.05)
                assert shown.peers.state is SyncState.SYNCED
                version = shown.mapping.version_sent
                plane.stop(signal.SIGKILL)
            with (
                ControlPlaneProcess(tmp_path, listen=plane.address, lease_ms=10_000) as again,
                cloud(again.address, "cloud-a"),
                cloud(again.address, "cloud-b"),
            ):
                while (mapping := engine.mappings.get(timeout=PATIENCE_S)).version <= version:
                    pass
                assert servers_of(mapping) == {"cloud-a", "cloud-b"}
                client.stop()
                assert "robot" not in again.status()
        finally:
            client.stop()
