"""One stream's ends, with a connection that breaks when the test wants it; the streams themselves are integration's."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Any, cast

import grpc

from controlplane.mailbox import Mailbox
from controlplane.service import ControlPlaneService
from protos.convert import sidecar_message_to_proto
from protos.model import PeerSet, Version
from tests.unit.controlplane.samples import registration

if TYPE_CHECKING:
    from controlplane.loop import ControlLoop
    from controlplane.service import Context


class Loop:
    """Admits everybody, and has something to tell at once."""

    def __init__(self) -> None:
        self.gone: list[object] = []

    def register(self, *_: object) -> tuple[int, Mailbox]:
        mailbox = Mailbox()
        mailbox.put(PeerSet(Version(1), nonce=1))
        return 7, mailbox

    def disconnected(self, stream: object) -> None:
        self.gone.append(stream)


class Broken:
    """A call that registers and says no more, and whose connection is gone when it is answered."""

    def __init__(self) -> None:
        self._first: list[bytes] = [sidecar_message_to_proto(registration("robot")).SerializeToString()]

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
