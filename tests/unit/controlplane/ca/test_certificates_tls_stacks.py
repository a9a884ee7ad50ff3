"""TLS libraries agree with us on the certificates: OpenSSL, at its strictest, on both ends of a handshake."""

from __future__ import annotations

import contextlib
import ssl
from typing import TYPE_CHECKING

import pytest

from plr.controlplane.ca import Authority, Issued, Validity
from plr.controlplane.ca.files import write_tls_files
from plr.protos.trust.identity import CONTROL_PLANE_DNS, IdentityRole

if TYPE_CHECKING:
    from pathlib import Path


def context(folder: Path, side: int) -> ssl.SSLContext:
    made = ssl.SSLContext(side)
    made.minimum_version = ssl.TLSVersion.TLSv1_3
    made.verify_flags |= ssl.VERIFY_X509_STRICT
    made.verify_mode = ssl.CERT_REQUIRED
    made.load_verify_locations(folder / "ca.pem")
    made.load_cert_chain(folder / "cert.pem", folder / "key.pem")
    return made


def shake_hands(server: Path, client: Path) -> tuple[bytes, bytes]:
    """Return the certificates that client and server saw, DER; raises ssl.SSLError."""
    to_server, to_client = ssl.MemoryBIO(), ssl.MemoryBIO()
    serving = context(server, ssl.PROTOCOL_TLS_SERVER).wrap_bio(to_server, to_client, server_side=True)
    calling = context(client, ssl.PROTOCOL_TLS_CLIENT).wrap_bio(to_client, to_server, server_hostname=CONTROL_PLANE_DNS)
    for _ in range(4):
        for end in (calling, serving):
            with contextlib.suppress(ssl.SSLWantReadError):
                end.do_handshake()
    seen_by_client, seen_by_server = calling.getpeercert(binary_form=True), serving.getpeercert(binary_form=True)
    assert seen_by_client
    assert seen_by_server
    return seen_by_client, seen_by_server


@pytest.fixture
def ca() -> Authority:
    return Authority.create()


def folder_of(tmp_path: Path, ca: Authority, name: str, issued: Issued) -> Path:
    write_tls_files(tmp_path / name, issued, ca.ca_pem, ca.crl_pem())
    return tmp_path / name


@pytest.fixture
def control_plane(tmp_path: Path, ca: Authority) -> Path:
    return folder_of(tmp_path, ca, "cp", ca.issue("cp", IdentityRole.CONTROL_PLANE))


@pytest.mark.parametrize("role", IdentityRole)
def test_every_role_can_call_the_control_plane(
    tmp_path: Path, ca: Authority, control_plane: Path, role: IdentityRole
) -> None:
    issued = ca.issue("node-1", role)
    seen = shake_hands(control_plane, folder_of(tmp_path, ca, "node-1", issued))
    assert seen[1] == issued.certificate_der


@pytest.mark.parametrize("role", [IdentityRole.ROBOT, IdentityRole.CLOUD, IdentityRole.OPERATOR])
def test_nobody_else_passes_for_the_control_plane(
    tmp_path: Path, ca: Authority, control_plane: Path, role: IdentityRole
) -> None:
    rogue = folder_of(tmp_path, ca, "rogue", ca.issue("rogue", role))
    with pytest.raises(ssl.SSLCertVerificationError):
        shake_hands(rogue, control_plane)


def test_an_expired_node_is_refused(tmp_path: Path, ca: Authority, control_plane: Path) -> None:
    now = ca.own.certificate.not_valid_before_utc.timestamp()
    issued = ca.issue("late", IdentityRole.ROBOT, validity=Validity(now, now + 1))
    with pytest.raises(ssl.SSLError, match="certificate"):
        shake_hands(control_plane, folder_of(tmp_path, ca, "late", issued))


def test_during_a_rotation_both_cas_count(tmp_path: Path, ca: Authority, control_plane: Path) -> None:
    robot = folder_of(tmp_path, ca, "robot-1", ca.issue("robot-1", IdentityRole.ROBOT))
    ca.rotate("next")
    for node in (control_plane, robot):
        (node / "ca.pem").write_bytes(ca.ca_pem)
    shake_hands(control_plane, robot)
    renewed = ca.renew("robot-1")
    write_tls_files(robot, renewed, ca.ca_pem, ca.crl_pem())
    assert shake_hands(control_plane, robot)[1] == renewed.certificate_der
    write_tls_files(control_plane, ca.renew("cp"), ca.ca_pem, ca.crl_pem())
    ca.retire()
    for node in (control_plane, robot):
        (node / "ca.pem").write_bytes(ca.ca_pem)
        shake_hands(control_plane, robot)
