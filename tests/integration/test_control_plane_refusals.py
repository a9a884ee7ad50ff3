"""What a control plane does not take, and says so, over real gRPC."""

from __future__ import annotations

import random
import re
import time
import urllib.request
from dataclasses import replace

import grpc
import pytest

from plr.protos.convert import sidecar_message_to_proto
from plr.protos.model.ids import PROTOCOL_VERSION, Role
from plr.protos.model.stream import Welcome
from plr.protos.plr.v1 import admin_pb2, admin_pb2_grpc, control_pb2
from tests.support.control_plane_process import (
    PATIENCE_S,
    ControlPlaneProcess,
    Sidecar,
    Stream,
    cloud,
    open_channel,
)
from tests.support.samples import registration


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
        (
            raw_register(protocol_version=1, newest_protocol_version=0),
            grpc.StatusCode.FAILED_PRECONDITION,
            f"the sidecar speaks protocol version 1, this control plane {PROTOCOL_VERSION}: upgrade the sidecar",
        ),
        (
            raw_register(protocol_version=98, newest_protocol_version=99, name="\x00"),
            grpc.StatusCode.FAILED_PRECONDITION,
            "protocol version 98 to 99, this control plane 3: upgrade the control plane",
        ),
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


def test_a_refused_version_is_counted_and_told_by_name_once_a_minute(alone: ControlPlaneProcess) -> None:
    def count(reason: str) -> int:
        with urllib.request.urlopen(f"http://{alone.metrics}/metrics", timeout=PATIENCE_S) as answer:
            found = re.search(rf'plr_registrations_refused_total{{reason="{reason}"}} (\d+)', answer.read().decode())
        assert found is not None
        return int(found[1])

    for _ in range(3):
        with Stream(alone.address) as stream:
            stream.send_raw(raw_register(protocol_version=98, newest_protocol_version=99, name="robot-9"))
            stream.end()
    with Stream(alone.address) as stream:
        stream.send_raw(control_pb2.SidecarMessage())
        stream.end()
    end = time.monotonic() + PATIENCE_S
    while (count("version"), count("malformed")) != (3, 1):
        assert time.monotonic() < end
        time.sleep(0.1)
    with open_channel(alone.address, None) as channel:
        events = admin_pb2_grpc.AdminStub(channel).ListEvents(admin_pb2.ListEventsRequest()).events
    (told,) = [event for event in events if event.kind == admin_pb2.EVENT_KIND_REFUSED]
    assert told.node == "robot-9"
    assert "upgrade the control plane" in told.text


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
        assert good.quiet_for(0.1) or alone.status()["cloud-g"].connected


def test_bytes_that_are_no_message_get_a_clear_status(plane: ControlPlaneProcess) -> None:
    rng = random.Random(4)
    with grpc.insecure_channel(plane.address) as channel:
        connect: grpc.StreamStreamMultiCallable[bytes, bytes] = channel.stream_stream("/plr.v1.ControlPlane/Connect")
        for data in (b"\xff", b"\x0a\x7f", rng.randbytes(200), b""):
            call = connect(iter([data]), timeout=PATIENCE_S)
            with pytest.raises(grpc.RpcError):
                list(call)
            assert call.code() is grpc.StatusCode.INVALID_ARGUMENT


@pytest.mark.audit("ops-10")
def test_what_a_newer_sidecar_says_ends_no_stream(plane: ControlPlaneProcess) -> None:
    newer = registration("newer")
    newer = replace(newer, newest_protocol_version=PROTOCOL_VERSION + 1)
    with Sidecar(plane.address, newer) as sidecar:
        sidecar.expect(Welcome)
        before = len(plane.lines)
        for _ in range(3):
            sidecar.send_raw(control_pb2.SidecarMessage.FromString(b"\xaa\x06\x02hi"))  # field 101
        plane.wait_for_line("left out a message of no known kind", after=before)
        assert plane.status()["newer"].connected
        assert sum("left out" in line for line in plane.lines[before:]) == 1


def test_a_stream_that_ends_before_it_registers_is_no_error(plane: ControlPlaneProcess) -> None:
    with Stream(plane.address) as stream:
        stream.half_close()
        assert stream.end()[0] is grpc.StatusCode.OK
