"""A control plane for tests: a real gRPC server that records what it hears and says what the test tells it to."""

from __future__ import annotations

import asyncio
import queue
import threading
from typing import TYPE_CHECKING, TypeVar

import grpc

from plr.protos.convert import control_message_to_proto, sidecar_message_from_proto
from plr.protos.model.members import Registration
from plr.protos.plr.v1 import control_pb2, control_pb2_grpc

if TYPE_CHECKING:
    from collections.abc import AsyncIterator
    from typing import Self

    from plr.protos.model.stream import ControlMessage, SidecarMessage, Welcome

WAIT_S = 20.0
"""Far more than anything takes here: a busy machine must not fail a test."""

END = "end of stream"

M = TypeVar("M")


class ScriptedControlPlane(control_pb2_grpc.ControlPlaneServicer):
    """Serves on `port` of the loopback interface while used as a context."""

    def __init__(self, port: int = 0, *, welcome: Welcome | None = None) -> None:
        self.port = port
        self.welcome = welcome
        self.refusal: tuple[grpc.StatusCode, str] | None = None
        self.heard: queue.Queue[SidecarMessage | str] = queue.Queue()
        self._outgoing: asyncio.Queue[control_pb2.ControlMessage | None] | None = None
        self._ready = threading.Event()
        self._thread = threading.Thread(target=self._run, name="scripted-control-plane")

    @property
    def target(self) -> str:
        return f"127.0.0.1:{self.port}"

    def __enter__(self) -> Self:
        self._thread.start()
        assert self._ready.wait(WAIT_S)
        return self

    def __exit__(self, *_: object) -> None:
        self._loop.call_soon_threadsafe(self._end.set)
        self._thread.join(WAIT_S)
        assert not self._thread.is_alive()

    def say(self, message: ControlMessage) -> None:
        """Send on the current stream."""
        self.say_raw(control_message_to_proto(message))

    def say_raw(self, message: control_pb2.ControlMessage) -> None:
        assert self._outgoing is not None
        self._loop.call_soon_threadsafe(self._outgoing.put_nowait, message)

    def close_stream(self) -> None:
        assert self._outgoing is not None
        self._loop.call_soon_threadsafe(self._outgoing.put_nowait, None)

    def expect(self, kind: type[M]) -> M:
        """Return the next message of this kind, skipping others."""
        while True:
            message = self.heard.get(timeout=WAIT_S)
            if isinstance(message, kind):
                return message

    # ── the server's thread ──

    def _run(self) -> None:
        asyncio.run(self._serve())

    async def _serve(self) -> None:
        self._loop = asyncio.get_running_loop()
        self._end = asyncio.Event()
        server = grpc.aio.server()
        control_pb2_grpc.add_ControlPlaneServicer_to_server(self, server)
        self.port = server.add_insecure_port(self.target)
        await server.start()
        self._ready.set()
        await self._end.wait()
        await server.stop(None)

    async def Connect(
        self,
        request_iterator: AsyncIterator[control_pb2.SidecarMessage],
        context: grpc.aio.ServicerContext[control_pb2.SidecarMessage, control_pb2.ControlMessage],
    ) -> AsyncIterator[control_pb2.ControlMessage]:
        outgoing: asyncio.Queue[control_pb2.ControlMessage | None] = asyncio.Queue()
        self._outgoing = outgoing
        listener = asyncio.ensure_future(self._listen(request_iterator, outgoing))
        try:
            while (message := await outgoing.get()) is not None:
                yield message
            if self.refusal is not None:
                await context.abort(*self.refusal)
        finally:
            listener.cancel()
            self.heard.put(END)

    async def _listen(
        self,
        messages: AsyncIterator[control_pb2.SidecarMessage],
        outgoing: asyncio.Queue[control_pb2.ControlMessage | None],
    ) -> None:
        async for message in messages:
            value = sidecar_message_from_proto(message)
            self.heard.put(value)
            if isinstance(value, Registration):
                if self.refusal is not None:
                    outgoing.put_nowait(None)
                elif self.welcome is not None:
                    outgoing.put_nowait(control_message_to_proto(self.welcome))
        outgoing.put_nowait(None)
