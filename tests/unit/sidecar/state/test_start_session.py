"""The credential of a run, from the files of a node's certificate to the judgement of its peers."""

from __future__ import annotations

import time
from dataclasses import replace
from typing import TYPE_CHECKING

import pytest
from cryptography.hazmat.primitives.asymmetric import ec

from plr.controlplane.ca import Authority
from plr.controlplane.ca.files import write_tls_files
from plr.protos.base.errors import ConfigError, DecodeError
from plr.protos.model.ids import Role, SessionId
from plr.protos.model.members import Peer
from plr.protos.program.tls_files import TlsFiles, load_tls_files
from plr.protos.trust.clock_floor import ClockFloor
from plr.protos.trust.credential import SessionCredential, verify
from plr.protos.trust.identity import MALFORMED, REVOKED, UNTRUSTED, WRONG_ROLE, CertificateError, IdentityRole, Trust
from plr.sidecar.core.wire.introduction import MAX_INTRODUCED_BYTES
from plr.sidecar.state import start_session as module
from plr.sidecar.state.start_session import preferred_aead, signed, start_session

if TYPE_CHECKING:
    from pathlib import Path

    from plr.sidecar.core.crypto.session import OwnSession

TOKEN = bytes(16)


class Fleet:
    """A CA and the folders it filled."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.ca = Authority.create()

    def issue(self, name: str, role: IdentityRole = IdentityRole.ROBOT) -> TlsFiles:
        self.ca.write_tls_dir(self.folder / name, name, role)
        return load_tls_files(self.folder / name)

    def session(self, files: TlsFiles, incarnation: int = 1) -> OwnSession:
        return start_session(
            files.identity.name, Role(files.identity.role.value), incarnation, lambda: files, ClockFloor(time.time)
        )

    def trust(self) -> Trust:
        return Trust(self.ca.ca_pem, self.ca.crl_pem())


@pytest.fixture
def fleet(tmp_path: Path) -> Fleet:
    return Fleet(tmp_path)


def as_peer(credential: SessionCredential) -> Peer:
    fields = (credential.name, credential.role, credential.session, TOKEN, credential.incarnation)
    return Peer(*fields, credential=credential.encode())


def refusal(credential: SessionCredential, fleet: Fleet, now: float) -> str:
    with pytest.raises(CertificateError) as caught:
        verify(credential, lambda certificate: fleet.trust().check(certificate, now))
    return caught.value.reason


def test_two_nodes_of_one_fleet_admit_each_other_and_share_a_secret(fleet: Fleet) -> None:
    robot = fleet.session(fleet.issue("robot-1"))
    cloud = fleet.session(fleet.issue("cloud-a", IdentityRole.CLOUD))
    ours = robot.admit(as_peer(cloud.credential))
    theirs = cloud.admit(as_peer(robot.credential))
    assert ours.secret == theirs.secret
    assert ours.first is not theirs.first
    assert len(robot.credential.encode()) <= MAX_INTRODUCED_BYTES


def test_a_node_of_another_fleet_is_refused(fleet: Fleet, tmp_path: Path) -> None:
    robot = fleet.session(fleet.issue("robot-1"))
    other = Fleet(tmp_path / "other")
    stranger = other.session(other.issue("cloud-a", IdentityRole.CLOUD))
    with pytest.raises(DecodeError, match="another CA"):
        robot.admit(as_peer(stranger.credential))


def test_what_a_credential_may_not_say(fleet: Fleet) -> None:
    files = fleet.issue("robot-1")
    credential = fleet.session(files).credential
    now = files.identity.not_before + 1.0
    verify(credential, lambda certificate: fleet.trust().check(certificate, now))
    thief = ec.generate_private_key(ec.SECP256R1())
    for changed, reason in (
        (replace(credential, session=SessionId(1)), UNTRUSTED),
        (replace(credential, incarnation=99), UNTRUSTED),
        (replace(credential, public_key=bytes(32)), UNTRUSTED),
        (credential.sign(thief), UNTRUSTED),
        (replace(credential, signature=b""), UNTRUSTED),
        (replace(credential, name=fleet.issue("robot-2").identity.name).sign(files.private_key), WRONG_ROLE),
        (replace(credential, role=Role.CLOUD).sign(files.private_key), WRONG_ROLE),
        (replace(credential, certificate=b"", signature=b""), MALFORMED),
        (replace(credential, session=SessionId(1)).sign(files.private_key), MALFORMED),
        (replace(credential, public_key=bytes(32)).sign(files.private_key), MALFORMED),
    ):
        assert refusal(changed, fleet, now) == reason


def test_a_certificate_that_ended_or_was_revoked_signs_for_nobody(fleet: Fleet) -> None:
    files = fleet.issue("robot-1")
    credential = fleet.session(files).credential
    assert refusal(credential, fleet, files.identity.not_after + 1.0) == "expired"
    assert refusal(credential, fleet, files.identity.not_before - 1.0) == "not_yet_valid"
    fleet.ca.revoke("robot-1")
    assert refusal(credential, fleet, files.identity.not_before + 1.0) == REVOKED


def test_operators_and_the_control_plane_have_no_sessions(fleet: Fleet) -> None:
    """Their certificates are good, but not for a robot or a cloud."""
    robot = fleet.session(fleet.issue("robot-1"))
    for name, role in (("op", IdentityRole.OPERATOR), ("cp", IdentityRole.CONTROL_PLANE)):
        files = fleet.issue(name, role)
        posing = replace(robot.credential, name=files.identity.name, role=Role.CLOUD)
        with pytest.raises(DecodeError):
            robot.admit(as_peer(signed(posing, files)))


def test_a_renewed_certificate_signs_the_same_session(fleet: Fleet) -> None:
    robot = fleet.session(fleet.issue("robot-1"))
    cloud = fleet.session(fleet.issue("cloud-a", IdentityRole.CLOUD))
    before = cloud.admit(as_peer(robot.credential))
    write_tls_files(fleet.folder / "robot-1", fleet.ca.renew("robot-1"), fleet.ca.ca_pem, fleet.ca.crl_pem())
    renewed = signed(robot.credential, load_tls_files(fleet.folder / "robot-1"))
    assert renewed.certificate != robot.credential.certificate
    robot.renew(renewed)
    assert cloud.admit(as_peer(renewed)) == before


def test_a_certificate_too_long_to_introduce_is_refused_at_the_start(fleet: Fleet) -> None:
    files = replace(fleet.issue("robot-1"), certificate_der=bytes(1200))
    with pytest.raises(ConfigError, match=r"cert\.pem: expected a certificate at least \d+ bytes shorter"):
        fleet.session(files)


def test_every_session_has_another_number_and_key(fleet: Fleet) -> None:
    files = fleet.issue("robot-1")
    first, second = fleet.session(files).credential, fleet.session(files, 2).credential
    assert first.session != second.session
    assert first.public_key != second.public_key


@pytest.mark.parametrize(
    ("cpuinfo", "aead"),
    [
        ("flags\t: fpu aes sse\n", "AES_256_GCM"),
        ("Features : fp aes\n", "AES_256_GCM"),
        ("flags : fpu\n", "CHACHA20_POLY1305"),
    ],
)
def test_aes_where_the_processor_knows_it(
    cpuinfo: str, aead: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "cpuinfo"
    file.write_text(cpuinfo)
    monkeypatch.setattr(module, "CPUINFO", file)
    assert preferred_aead().name == aead
    file.unlink()
    assert preferred_aead().name == "CHACHA20_POLY1305"
