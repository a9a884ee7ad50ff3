"""One stream's ends, with a connection that breaks when the test wants it; the streams themselves are integration's."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Any, cast

import grpc
import pytest

from plr.controlplane.core.overload.report_share import ReportShares
from plr.controlplane.serve import service as module
from plr.controlplane.serve.mailbox import Mailbox
from plr.controlplane.serve.service import ControlPlaneService
from plr.controlplane.serve.stream_limits import MAX_FIRST_BYTES
from plr.protos.convert import sidecar_message_to_proto
from plr.protos.model.ids import Version
from plr.protos.model.members import PeerSet
from plr.protos.model.report import Report
from plr.protos.model.stream import Heartbeat
from plr.protos.plr.v1 import control_pb2
from tests.support.samples import registration

if TYPE_CHECKING:
    from plr.controlplane.loop import ControlLoop
    from plr.controlplane.serve.service import Context


class Loop:
    """Admits everybody, and has something to tell at once."""

    def __init__(self) -> None:
        self.gone: list[object] = []
        self.report_shares = ReportShares()

    def register(self, *_: object) -> tuple[int, Mailbox]:
        mailbox = Mailbox()
        mailbox.put(PeerSet(Version(1), nonce=1))
        return 7, mailbox

    def refuse(self, *_: object) -> None:
        pass

    def stream_ended(self, *_: object) -> None:
        pass

    def disconnected(self, stream: object) -> None:
        self.gone.append(stream)


class Ended(Exception):
    """The call was ended with this status."""


class Broken:
    """A call that says one thing, a registration, and whose connection is gone when it is answered."""

    def __init__(self, first: bytes | None = None) -> None:
        self._first: list[bytes] = [first or sidecar_message_to_proto(registration("robot")).SerializeToString()]

    async def abort(self, code: grpc.StatusCode, details: str) -> None:
        raise Ended(code, details)

    def peer(self) -> str:
        return "test"

    async def read(self) -> bytes:
        if self._first:
            return self._first.pop()
        await asyncio.Event().wait()
        raise AssertionError

    async def write(self, _: Any) -> None:
        raise grpc.aio.InternalError("Failed")


def test_a_connection_that_breaks_under_a_message_ends_its_stream_without_a_fault_of_ours() -> None:
    loop = Loop()
    service = ControlPlaneService(cast("ControlLoop", loop), 0.5, None)

    async def serve() -> None:
        async with asyncio.timeout(10.0):
            await service.connect(None, cast("Context", Broken()))

    asyncio.run(serve())
    assert loop.gone == [7]


@pytest.mark.audit("ops-16")
def test_who_is_not_registered_is_given_no_time_and_no_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    """A first message is short, or is never looked into, and only a registration is checked."""

    def unread(_: object) -> object:
        raise AssertionError("looked into")

    monkeypatch.setattr(module, "sidecar_message_from_proto", unread)
    report = control_pb2.Report(joints=[control_pb2.JointReport()] * MAX_FIRST_BYTES)
    short = [sidecar_message_to_proto(said).SerializeToString() for said in (Heartbeat(), Report())]
    for first in (control_pb2.SidecarMessage(report=report).SerializeToString(), *short):
        with monkeypatch.context() as patch:
            if len(first) > MAX_FIRST_BYTES:
                patch.setattr(module, "read_sidecar_message", unread)
            with pytest.raises(Ended) as ended:
                asyncio.run(
                    ControlPlaneService(cast("ControlLoop", Loop()), 0.5, None).connect(
                        None, cast("Context", Broken(first))
                    )
                )
        assert ended.value.args == (
            grpc.StatusCode.INVALID_ARGUMENT,
            "the first message has to be a registration",
        )
