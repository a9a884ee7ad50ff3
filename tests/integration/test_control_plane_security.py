"""Who is let in to the control plane: each refusal is a real attempt over TLS, and is counted with its reason."""

from __future__ import annotations

import asyncio
import contextlib
import resource
import socket
import ssl
import subprocess
import time
from dataclasses import replace
from typing import TYPE_CHECKING

import grpc
import pytest
from grpc_health.v1 import health_pb2, health_pb2_grpc
from grpc_reflection.v1alpha import reflection_pb2, reflection_pb2_grpc

from plr.controlplane.ca import Authority, Validity
from plr.controlplane.serve.tls_gate import MAX_SILENT_PER_SOURCE
from plr.protos.convert import sidecar_message_to_proto
from plr.protos.model.ids import Role
from plr.protos.model.mapping import MappingSet
from plr.protos.model.members import RemovalReason
from plr.protos.model.report import Report
from plr.protos.model.stream import Welcome
from plr.protos.plr.v1 import admin_pb2, admin_pb2_grpc, control_pb2, control_pb2_grpc
from plr.protos.trust.identity import CONTROL_PLANE_DNS, IdentityRole
from tests.support.control_plane_process import PATIENCE_S, Secured, Sidecar, Stream, cloud, open_channel, robot
from tests.support.samples import registration
from tests.support.secured_control_plane import HOUR_S, SecuredControlPlane

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path


@pytest.fixture(scope="module")
def plane(tmp_path_factory: pytest.TempPathFactory) -> Iterator[SecuredControlPlane]:
    with SecuredControlPlane(tmp_path_factory.mktemp("plane")) as process:
        yield process
        process.stop_flawless()


def refused(address: str, secured: Secured | None) -> grpc.RpcError:
    """Try to register; returns the error of it."""
    with Sidecar(address, registration("robot-1"), secured) as stream, pytest.raises(grpc.RpcError) as error:
        stream.next()
    return error.value


def test_members_are_let_in_under_their_names(plane: SecuredControlPlane) -> None:
    a, r = plane.member("cloud-a", IdentityRole.CLOUD), plane.member("robot-1")
    with cloud(plane.address, "cloud-a", a) as c, robot(plane.address, "robot-1", r) as r1:
        assert r1.peers("cloud-a").peers[0].credential == c.registration.credential
        c.peers("robot-1")


@pytest.mark.parametrize("case", ["untrusted", "expired", "not_yet_valid"])
def test_certificates_that_are_no_good_are_refused(plane: SecuredControlPlane, case: str) -> None:
    now = time.time()
    match case:
        case "untrusted":
            secured = Secured(Authority.create().issue("robot-1", IdentityRole.ROBOT), plane.authority.ca_pem)
        case "expired":
            secured = plane.member("old", validity=Validity(now - 2 * HOUR_S, now - HOUR_S))
        case _:
            secured = plane.member("young", validity=Validity(now + HOUR_S, now + 2 * HOUR_S))
    with plane.counted(case):
        refused(plane.address, secured)


@pytest.mark.audit("ops-3")
def test_a_member_that_is_refused_reads_why_and_is_logged_by_its_name_once_a_minute(plane: SecuredControlPlane) -> None:
    now = time.time()
    secured = plane.member("ended", validity=Validity(now - 2 * HOUR_S, now - HOUR_S))
    for _ in range(3):
        error = refused(plane.address, secured)
        assert error.code() is grpc.StatusCode.UNAUTHENTICATED
        assert "the certificate of ended expired" in (error.details() or "")
    lines = [line for line in plane.lines if "the certificate of ended expired" in line]
    assert len(lines) == 1
    assert ": expired: the certificate of ended expired " in lines[0]


def test_who_shows_no_certificate_or_speaks_no_tls_is_refused(plane: SecuredControlPlane) -> None:
    host, port = plane.address.split(":")
    with plane.counted("no_certificate"), socket.create_connection((host, int(port))) as raw:
        context = ssl.create_default_context(cadata=plane.authority.ca_pem.decode())
        with context.wrap_socket(raw, server_hostname=CONTROL_PLANE_DNS) as tls:
            assert tls.recv(1) == b""
    with plane.counted("not_tls"):
        refused(plane.address, None)


@pytest.mark.filterwarnings("ignore:ssl.TLSVersion:DeprecationWarning")
def test_tls_1_2_is_refused(plane: SecuredControlPlane) -> None:
    with plane.counted("old_tls"):
        argv = ["openssl", "s_client", "-tls1_2", "-connect", plane.address]
        done = subprocess.run(argv, stdin=subprocess.DEVNULL, capture_output=True, text=True, check=False)
    assert "Cipher is (NONE)" in done.stdout


def test_a_half_open_handshake_ends(plane: SecuredControlPlane) -> None:
    host, port = plane.address.split(":")
    with plane.counted("handshake_timeout"), socket.create_connection((host, int(port)), PATIENCE_S) as raw:
        raw.settimeout(PATIENCE_S)
        with contextlib.suppress(ConnectionResetError):
            assert raw.recv(1) == b""


@pytest.mark.audit("sec-7")
def test_many_half_open_handshakes_do_not_keep_out_who_comes_from_the_same_place(plane: SecuredControlPlane) -> None:
    host, port = plane.address.split(":")
    _, most = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (most, most))
    with contextlib.ExitStack() as stack:
        with plane.counted("too_many_handshakes"):
            for _ in range(MAX_SILENT_PER_SOURCE + 20):
                stack.enter_context(socket.create_connection((host, int(port))))
        with Sidecar(plane.address, registration("robot-1"), plane.member("robot-1")) as stream:
            stream.expect(Welcome)


def test_a_name_or_role_that_the_certificate_does_not_say_is_refused(plane: SecuredControlPlane) -> None:
    secured, total = plane.member("robot-1"), "plr_registrations_refused_total"
    for reason, said in (
        ("name_mismatch", registration("robot-2")),
        ("wrong_role", registration("robot-1", Role.CLOUD)),
    ):
        with plane.counted(reason, total), Stream(plane.address, secured) as stream:
            stream.send(secured.claim(said))
            code, text = stream.end()
            assert code is grpc.StatusCode.PERMISSION_DENIED
            assert "certificate" in text


def test_a_credential_of_another_run_or_badly_signed_is_refused(plane: SecuredControlPlane) -> None:
    secured, total = plane.member("robot-1"), "plr_registrations_refused_total"
    said = registration("robot-1")
    other_run = secured.claim(registration("robot-1", incarnation=2)).credential
    forged = bytearray(secured.claim(said).credential)
    forged[-1] ^= 1
    for credential in (b"", b"\xff" * 100, other_run, bytes(forged)):
        with plane.counted("bad_credential", total), Stream(plane.address, secured) as stream:
            stream.send(replace(said, credential=credential))
            code, _ = stream.end()
            assert code is grpc.StatusCode.PERMISSION_DENIED


def test_each_service_is_for_its_roles_only(plane: SecuredControlPlane) -> None:
    operator, r = plane.member("alice", IdentityRole.OPERATOR), plane.member("robot-1")
    with plane.counted("wrong_role"):
        error = refused(plane.address, operator)
        assert error.code() is grpc.StatusCode.PERMISSION_DENIED
    with open_channel(plane.address, operator) as channel:
        admin_pb2_grpc.AdminStub(channel).GetStatus(admin_pb2.GetStatusRequest(), timeout=PATIENCE_S)
        assert list(status_parts(channel))
        listed = reflect(channel)
        assert listed.code() is grpc.StatusCode.OK
    with open_channel(plane.address, r) as channel:
        with plane.counted("wrong_role"), pytest.raises(grpc.RpcError, match=r"which may not use plr\.v1\.Admin"):
            admin_pb2_grpc.AdminStub(channel).GetStatus(admin_pb2.GetStatusRequest(), timeout=PATIENCE_S)
        with plane.counted("wrong_role"), pytest.raises(grpc.RpcError, match=r"which may not use plr\.v1\.Admin"):
            list(status_parts(channel))
        with plane.counted("wrong_role"), pytest.raises(grpc.RpcError, match="ServerReflection"):
            reflect(channel)
        health = health_pb2_grpc.HealthStub(channel).Check(health_pb2.HealthCheckRequest(), timeout=PATIENCE_S)
        assert health.status == health_pb2.HealthCheckResponse.SERVING
        call: grpc.UnaryUnaryMultiCallable[bytes, bytes] = channel.unary_unary("/no.such.Service/Call")
        with pytest.raises(grpc.RpcError) as error_info:
            call(b"", timeout=PATIENCE_S)
        assert error_info.value.code() is grpc.StatusCode.UNIMPLEMENTED


def status_parts(channel: grpc.Channel) -> Iterator[admin_pb2.GetStatusResponse]:
    return admin_pb2_grpc.AdminStub(channel).StreamStatus(admin_pb2.StreamStatusRequest(), timeout=PATIENCE_S)


def reflect(channel: grpc.Channel) -> grpc.Call:
    requests = iter([reflection_pb2.ServerReflectionRequest(list_services="")])
    call = reflection_pb2_grpc.ServerReflectionStub(channel).ServerReflectionInfo(requests, timeout=PATIENCE_S)
    list(call)
    result: grpc.Call = call
    return result


def test_a_revoked_cloud_loses_its_stream_and_its_peers_are_told(plane: SecuredControlPlane) -> None:
    bad, r = plane.member("cloud-bad", IdentityRole.CLOUD), plane.member("robot-1")
    with robot(plane.address, "robot-1", r) as r1, cloud(plane.address, "cloud-bad", bad) as c:
        r1.peers("cloud-bad")
        r1.expect(MappingSet, lambda message: bool(message.services[0].assignments))
        plane.revoke("cloud-bad")
        code, text = c.end()
        assert code is grpc.StatusCode.UNAUTHENTICATED
        assert "revoked" in text
        gone = r1.peers()
        assert [(peer.name, peer.reason) for peer in gone.removed] == [("cloud-bad", RemovalReason.REVOKED)]
        r1.expect(MappingSet, lambda message: not message.services[0].assignments)
        with plane.counted("revoked"):
            error = refused(plane.address, bad)
            assert error.code() is grpc.StatusCode.UNAUTHENTICATED
            assert "the certificate of cloud-bad is revoked" in str(error)


async def write_late(address: str, member: Secured) -> tuple[grpc.StatusCode, bool]:
    """The status that a refused client finds which writes its registration some round trips after its call, and whether
    that write went through."""
    issued = member.issued
    credentials = grpc.ssl_channel_credentials(member.ca_pem, issued.key_pem, issued.certificate_pem)
    options = (("grpc.ssl_target_name_override", CONTROL_PLANE_DNS),)
    async with grpc.aio.secure_channel(address, credentials, options=options) as channel:
        call = control_pb2_grpc.ControlPlaneStub(channel).Connect()
        await call.wait_for_connection()
        await asyncio.sleep(0.1)
        written = True
        try:
            await call.write(sidecar_message_to_proto(registration("late-1")))
        except (grpc.aio.AioRpcError, asyncio.InvalidStateError):
            written = False
        return await call.code(), written


def test_a_refusal_waits_for_the_registration_that_it_would_make_fail(plane: SecuredControlPlane) -> None:
    """A write that fails hides the status of the refusal: gRPC then says INTERNAL."""
    member = plane.member("late-1")
    plane.revoke("late-1")
    for _ in range(3):
        assert asyncio.run(write_late(plane.address, member)) == (grpc.StatusCode.UNAUTHENTICATED, True)


def test_a_certificate_that_ends_takes_its_stream_with_it(plane: SecuredControlPlane) -> None:
    now = time.time()
    short = plane.member("short", validity=Validity(now - HOUR_S, now + 3.0))
    with Sidecar(plane.address, registration("short"), short) as stream:
        stream.expect(Welcome)
        with plane.counted("expired"):
            code, text = stream.end()
            assert code is grpc.StatusCode.UNAUTHENTICATED
            assert "certificate" in text


def test_new_files_are_taken_without_a_restart(plane: SecuredControlPlane) -> None:
    with Sidecar(plane.address, registration("robot-1"), plane.member("robot-1")) as before:
        before.expect(Welcome)
        other = Authority.create("next")
        plane.install("ca.pem", plane.authority.ca_pem + other.ca_pem)
        newcomer = Secured(other.issue("cloud-9", IdentityRole.CLOUD), plane.authority.ca_pem)
        with cloud(plane.address, "cloud-9", newcomer):
            before.peers("cloud-9")
    assert plane.count("plr_certificate_expiry_timestamp_seconds") > time.time()


def test_a_stream_that_speaks_too_fast_is_ended(plane: SecuredControlPlane) -> None:
    with Sidecar(plane.address, registration("robot-1"), plane.member("robot-1")) as stream:
        stream.expect(Welcome)
        with plane.counted("too_fast"):
            for _ in range(3000):
                stream.send(Report())
            code, text = stream.end()
            assert code is grpc.StatusCode.RESOURCE_EXHAUSTED
            assert "too fast" in text


def test_a_message_that_is_too_long_ends_the_stream(plane: SecuredControlPlane) -> None:
    with Sidecar(plane.address, registration("robot-1"), plane.member("robot-1")) as stream:
        stream.expect(Welcome)
        stream.send_raw(control_pb2.SidecarMessage(nack=control_pb2.Nack(error="x" * (5 << 20))))
        assert stream.end()[0] is grpc.StatusCode.RESOURCE_EXHAUSTED


def test_who_pings_without_pause_is_cut_off(plane: SecuredControlPlane, tmp_path: Path) -> None:
    member = plane.member("robot-1")
    shown = tmp_path / "shown.pem"
    shown.write_bytes(member.issued.certificate_pem + member.issued.key_pem)
    context = ssl.create_default_context(cadata=member.ca_pem.decode())
    context.load_cert_chain(shown)
    context.set_alpn_protocols(["h2"])
    host, port = plane.address.split(":")
    with socket.create_connection((host, int(port)), PATIENCE_S) as raw:
        with context.wrap_socket(raw, server_hostname=CONTROL_PLANE_DNS) as tls:
            # RFC 9113: the preface with empty settings, then PING frames.
            tls.sendall(b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n" + bytes((0, 0, 0, 4, 0, 0, 0, 0, 0)))
            received = b""
            while b"too_many_pings" not in received:
                with contextlib.suppress(BrokenPipeError, ConnectionResetError):
                    tls.sendall(bytes((0, 0, 8, 6, 0, 0, 0, 0, 0)) + bytes(8))
                data = tls.recv(1 << 16)
                assert data, received
                received += data


def test_one_name_gets_few_streams(plane: SecuredControlPlane) -> None:
    secured = plane.member("robot-1")
    with contextlib.ExitStack() as stack:
        waiting = [stack.enter_context(Stream(plane.address, secured)) for _ in range(3)]
        time.sleep(0.3)
        with plane.counted("too_many_streams"), Stream(plane.address, secured) as further:
            code, text = further.end()
            assert code is grpc.StatusCode.RESOURCE_EXHAUSTED
            assert "robot-1 has 3 streams open" in text
        assert waiting[0].quiet_for(0.1)
