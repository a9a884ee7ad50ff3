"""The sidecar's control client and `plr` with certificates: what works, and what their users read when it does not."""

from __future__ import annotations

import concurrent.futures
import contextlib
import queue
import random
import subprocess
import sys
import time
from typing import TYPE_CHECKING

import grpc
import pytest

from plr.controlplane.ca import Authority, Validity
from plr.controlplane.ca.files import write_atomically
from plr.protos.model.ids import Role
from plr.protos.model.members import PeerSet, ServiceSet
from plr.protos.model.report import Report
from plr.protos.model.stream import ResourceKind, Welcome
from plr.protos.program.tls_files import TlsWatch, load_tls_files
from plr.protos.trust.candidate_signature import verify_candidates
from plr.protos.trust.credential import decode_credential
from plr.protos.trust.identity import CertificateError, IdentityRole
from plr.protos.trust.revocation_views import revocation_set
from plr.sidecar.control import client
from plr.sidecar.control.announcement import Announcer
from plr.sidecar.control.client import ControlClient
from plr.sidecar.core.control.session import ControlSession
from plr.sidecar.net.control_dialer import ControlDialer
from tests.support.control_plane_process import (
    PATIENCE_S,
    ControlPlaneProcess,
    Sidecar,
    cloud,
    credential_of,
    with_own_session,
)
from tests.support.free_ports import free_port
from tests.support.samples import interfaces, registration, use
from tests.support.secured_control_plane import HOUR_S, SecuredControlPlane

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from plr.protos.model.mapping import MappingSet
    from plr.protos.program.tls_files import TlsFiles
    from plr.sidecar.core.base.report_scope import ReportScope


@pytest.fixture(scope="module")
def plane(tmp_path_factory: pytest.TempPathFactory) -> Iterator[SecuredControlPlane]:
    with SecuredControlPlane(tmp_path_factory.mktemp("plane")) as process:
        yield process


class Robot:
    """A control client with the files of a folder; what happens waits in queues."""

    def __init__(self, address: str, folder: Path | None, name: str = "robot-1") -> None:
        self.said = with_own_session(registration(name))
        self.session = ControlSession(self.said, random.Random(1))
        self.tls = TlsWatch(load_tls_files(folder)) if folder is not None else None
        if self.tls is not None:
            self.claim(self.tls.current)
        self.announcer: Announcer | None = None
        """Signs what it announces of itself, if it does."""
        self.client = ControlClient(ControlDialer((address,), self.session.stats), self.session, self, self, self.tls)
        self.welcomes: queue.Queue[Welcome] = queue.Queue()
        self.peers: queue.Queue[PeerSet] = queue.Queue()
        self.connection: queue.Queue[tuple[bool, str]] = queue.Queue()
        self.files: queue.Queue[TlsFiles] = queue.Queue()

    def claim(self, files: TlsFiles) -> None:
        self.session.set_credential(credential_of(self.said, files.certificate_der, files.private_key))

    def welcome(self, welcome: Welcome) -> None:
        self.welcomes.put(welcome)

    def apply_peers(self, peer_set: PeerSet) -> str | None:
        self.peers.put(peer_set)
        return None

    def apply_mapping(self, mapping: MappingSet) -> str | None:
        return None

    def applied(self, content: PeerSet | MappingSet) -> None:
        """Nothing to remember."""

    def take_report(self, scope: ReportScope) -> Report:
        return Report()

    def look_at_revocations(self) -> None:
        pass

    def end_expired(self) -> None:
        pass

    def judge_again(self) -> None:
        """Nobody is refused here."""

    def connection_changed(self, connected: bool, reason: str) -> None:
        self.connection.put((connected, reason))

    def certificate_changed(self, files: TlsFiles) -> None:
        self.claim(files)
        if self.announcer is not None:
            self.client.set_candidates(self.announcer.again())
        self.files.put(files)

    def __enter__(self) -> Robot:
        self.client.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.client.stop()


def test_a_renewed_certificate_is_shown_on_a_new_stream(
    plane: SecuredControlPlane, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(client, "LOOK_INTERVAL_S", 0.05)
    folder = tmp_path / "tls"
    plane.authority.write_tls_dir(folder, "robot-1", IdentityRole.ROBOT)
    with cloud(plane.address, "cloud-a", plane.member("cloud-a", IdentityRole.CLOUD)) as server:
        with Robot(plane.address, folder) as robot:
            assert robot.connection.get(timeout=PATIENCE_S) == (True, "registered")
            first = robot.peers.get(timeout=PATIENCE_S)
            server.peers("robot-1")
            renewed = plane.authority.renew("robot-1")
            replace_files(folder, renewed.key_pem, renewed.certificate_pem)
            files = robot.files.get(timeout=PATIENCE_S)
            assert files.certificate_der == renewed.certificate_der
            assert robot.connection.get(timeout=PATIENCE_S) == (False, "new certificate files")
            assert robot.connection.get(timeout=PATIENCE_S) == (True, "registered")
            assert robot.session.version(ResourceKind.PEERS) >= first.version


@pytest.mark.audit("ops-3")
def test_a_renewal_is_never_relayed_as_what_a_forger_says(
    plane: SecuredControlPlane, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Addresses signed with the one certificate beside the credential of the other: each peer logged a warning."""
    monkeypatch.setattr(client, "LOOK_INTERVAL_S", 0.05)
    folder = tmp_path / "tls"
    plane.authority.write_tls_dir(folder, "robot-11", IdentityRole.ROBOT)
    robot = Robot(plane.address, folder, "robot-11")
    tls = robot.tls
    assert tls is not None
    robot.announcer = Announcer(robot.said.session, lambda: tls.current, lambda _: ())
    robot.client.set_candidates(robot.announcer.announce(interfaces("wlan0")))
    robot.client.set_services(ServiceSet((), (use(),)))
    with cloud(plane.address, "cloud-a", plane.member("cloud-a", IdentityRole.CLOUD)) as server, robot:
        certificates = [tls.current.certificate_der]
        told_signed(server, certificates[-1])
        for _ in range(3):
            renewed = plane.authority.renew("robot-11")
            replace_files(folder, renewed.key_pem, renewed.certificate_pem)
            told_signed(server, renewed.certificate_der)


def told_signed(server: Sidecar, certificate: bytes) -> None:
    """Wait until the robot's addresses are told, signed with this certificate; none is told that did not sign them."""
    while True:
        found = server.expect(PeerSet)
        server.ack(found)
        for peer in found.peers:
            if not peer.candidates_signature:
                assert not peer.candidates
                continue
            by = decode_credential(peer.credential).certificate
            verify_candidates(by, peer.session, peer.candidates_serial, peer.candidates, peer.candidates_signature)
            if by == certificate:
                return


@pytest.mark.audit("sec-12")
def test_new_files_count_while_no_control_plane_is_there(
    plane: SecuredControlPlane, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also between two attempts to reach it, which may be long."""
    monkeypatch.setattr(client, "LOOK_INTERVAL_S", 0.05)
    folder = tmp_path / "tls"
    plane.authority.write_tls_dir(folder, "robot-6", IdentityRole.ROBOT)
    robot = Robot(f"127.0.0.1:{free_port()}", folder, "robot-6")
    closed = robot.session.closed

    def give_up(now: float, *, refused: bool = False, moved: bool = False) -> float:
        closed(now, refused=refused, moved=moved)
        robot.session._retry_at = now + HOUR_S
        return HOUR_S

    monkeypatch.setattr(robot.session, "closed", give_up)
    monkeypatch.setattr(robot.session, "network_changed", lambda _now: None)
    with robot:
        while robot.client.last_failure is None:
            time.sleep(0.05)
        time.sleep(0.2)
        plane.authority.publish()
        write_atomically(folder / "crl.pem", plane.authority.crl_pem(), 0o644)
        assert robot.files.get(timeout=PATIENCE_S).crl_pem == plane.authority.crl_pem()


def test_sidecars_are_told_what_is_revoked(plane: SecuredControlPlane, tmp_path: Path) -> None:
    """Also of nodes that this run of the control plane has never heard of."""
    plane.authority.write_tls_dir(tmp_path / "tls", "robot-5", IdentityRole.ROBOT)
    thief = plane.member("thief", IdentityRole.CLOUD).issued
    with Robot(plane.address, tmp_path / "tls", "robot-5") as robot:
        assert robot.tls is not None
        robot.tls.take_revocations(robot.welcomes.get(timeout=PATIENCE_S).crl)
        assert robot.tls.current.trust.check(thief.certificate_der, time.time()).name == "thief"
        plane.revoke("thief")
        assert robot.tls.take_revocations(robot.welcomes.get(timeout=PATIENCE_S).crl)
        with pytest.raises(CertificateError, match="the certificate of thief is revoked"):
            robot.tls.current.trust.check(thief.certificate_der, time.time())
        assert robot.client.stats.streams == 1


def replace_files(folder: Path, key: bytes, certificate: bytes) -> None:
    for name, content, mode in (("key.pem", key, 0o600), ("cert.pem", certificate, 0o644)):
        part = folder / "part"
        part.write_bytes(content)
        part.chmod(mode)
        part.replace(folder / name)


def failure(address: str, folder: Path | None) -> str:
    """Why the client cannot connect, as it is logged."""
    with Robot(address, folder) as robot:
        while robot.client.last_failure is None:
            time.sleep(0.02)
        return robot.client.last_failure


@contextlib.contextmanager
def expired_control_plane(authority: Authority, validity: Validity) -> Iterator[str]:
    """A gRPC server with a control plane's certificate that is not valid now."""
    issued = authority.issue("control-2", IdentityRole.CONTROL_PLANE, validity=validity)
    server = grpc.server(concurrent.futures.ThreadPoolExecutor(1))
    port = server.add_secure_port(
        "127.0.0.1:0", grpc.ssl_server_credentials([(issued.key_pem, issued.certificate_pem)])
    )
    server.start()
    yield f"127.0.0.1:{port}"
    server.stop(None)


def test_what_the_operator_reads_of_a_sidecar_that_does_not_get_in(plane: SecuredControlPlane, tmp_path: Path) -> None:
    now = time.time()
    stranger = Authority.create()
    stranger.write_tls_dir(tmp_path / "other", "robot-1", IdentityRole.ROBOT)
    assert f"is not issued by a CA in {tmp_path}/other/ca.pem" in failure(plane.address, tmp_path / "other")
    (tmp_path / "other" / "ca.pem").write_bytes(stranger.ca_pem + plane.authority.ca_pem)
    assert "it may not know our CA" in failure(plane.address, tmp_path / "other")
    past = Validity(now - 2 * HOUR_S, now - HOUR_S)
    future = Validity(now + HOUR_S, now + 2 * HOUR_S)
    plane.authority.write_tls_dir(tmp_path / "robot", "robot-late", IdentityRole.ROBOT)
    for validity in (past, future):
        with expired_control_plane(plane.authority, validity) as address:
            assert "compare the clocks" in failure(address, tmp_path / "robot")
    plane.authority.write_tls_dir(tmp_path / "old", "robot-old", IdentityRole.ROBOT, validity=past)
    assert "expired" in (told := failure(plane.address, tmp_path / "old"))
    assert "plr ca renew robot-old" in told
    assert "it may expect TLS" in failure(plane.address, None)
    plane.authority.write_tls_dir(tmp_path / "good", "robot-good", IdentityRole.ROBOT)
    (tmp_path / "insecure").mkdir()
    with ControlPlaneProcess(tmp_path / "insecure") as insecure:
        assert "does not use TLS" in failure(insecure.address, tmp_path / "good")
    assert "Connection refused" in failure(insecure.address, tmp_path / "good")


def test_a_name_that_is_not_the_certificates_is_refused_in_words(plane: SecuredControlPlane, tmp_path: Path) -> None:
    plane.authority.write_tls_dir(tmp_path / "tls", "robot-2", IdentityRole.ROBOT)
    assert "the certificate has another name" in failure(plane.address, tmp_path / "tls")


def plr(*arguments: str) -> subprocess.CompletedProcess[str]:
    argv = [sys.executable, "-m", "plr.controlplane.cli", *arguments]
    return subprocess.run(argv, capture_output=True, text=True, check=False)


@pytest.mark.audit("sec-12")
def test_plr_status_shows_who_uses_which_revocation_list(plane: SecuredControlPlane, tmp_path: Path) -> None:
    plane.authority.write_tls_dir(tmp_path / "bob", "bob", IdentityRole.OPERATOR)
    plane.authority.write_tls_dir(tmp_path / "tls", "robot-8", IdentityRole.ROBOT)
    plane.authority.publish()
    plane.install("crl.pem", plane.authority.crl_pem())
    trust = load_tls_files(tmp_path / "tls").trust
    old, new = trust.lists(), trust.with_revocations(plane.authority.crl_pem()).lists()
    ((was,), (now,)) = old.values(), new.values()
    assert was is not None
    assert now is not None

    def shown() -> str:
        return plr("status", "--address", plane.address, "--tls-dir", str(tmp_path / "bob")).stdout

    with Robot(plane.address, tmp_path / "tls", "robot-8") as robot:
        robot.client.set_revocations(revocation_set(old, too_old=1))
        robot.welcomes.get(timeout=PATIENCE_S)
        behind = f"revocation list {was.number}, signed 0.0 days ago: OLDER than the control plane's {now.number}"
        while behind not in (text := shown()):
            assert f"control plane: revocation list {now.number}, signed 0.0 days ago" in text
        assert "REVOCATION LIST TOO OLD of 1 CAs" in text
        robot.client.set_revocations(revocation_set(new))
        while behind in (text := shown()):
            pass
        assert text.count(f"revocation list {now.number}, signed") == 2


def test_plr_asks_with_an_operators_certificate(plane: SecuredControlPlane, tmp_path: Path) -> None:
    plane.authority.write_tls_dir(tmp_path / "alice", "alice", IdentityRole.OPERATOR)
    plane.authority.write_tls_dir(tmp_path / "robot", "robot-7", IdentityRole.ROBOT)
    with Sidecar(plane.address, registration("cloud-a", Role.CLOUD), plane.member("cloud-a", IdentityRole.CLOUD)) as c:
        c.expect(Welcome)
        shown = plr("status", "--address", plane.address, "--tls-dir", str(tmp_path / "alice"))
        assert shown.returncode == 0, shown.stderr
        assert "cloud-a" in shown.stdout
    denied = plr("status", "--address", plane.address, "--tls-dir", str(tmp_path / "robot"))
    assert denied.returncode == 1
    assert "the certificate of robot-7 has the role robot, which may not use plr.v1.Admin" in denied.stderr
    insecure = plr("status", "--address", plane.address, "--insecure")
    assert insecure.returncode == 1
    assert "it may expect TLS" in insecure.stderr
    missing = plr("status", "--address", plane.address, "--tls-dir", str(tmp_path / "none"))
    assert missing.returncode == 2
    assert missing.stderr.count("\n") == 1
