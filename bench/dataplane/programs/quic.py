"""Runs aioquic: a live connection with a stream for each message, over UDP sockets, or in memory without any."""

from __future__ import annotations

import asyncio
import datetime
import os
import ssl
import threading
import time
from typing import TYPE_CHECKING, Any, TypeVar

from aioquic.asyncio.client import connect
from aioquic.asyncio.protocol import QuicConnectionProtocol
from aioquic.asyncio.server import serve as listen
from aioquic.quic.configuration import QuicConfiguration
from aioquic.quic.connection import QuicConnection
from aioquic.quic.events import ProtocolNegotiated, QuicEvent, StreamDataReceived
from cryptography import x509
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import NameOID

from bench.dataplane.calling import HEADER, Caller, Plan, usage
from bench.dataplane.remote import serve

if TYPE_CHECKING:
    from collections.abc import Callable, Coroutine

_T = TypeVar("_T")

START_TIMEOUT_S = 10.0
_WINDOW_BYTES = 64 << 20
"""Window that keeps flow control out of the way: the protocol's cost is measured, not its default buffer."""
_ALPN = ["bench"]
_MEMORY_ADDRESS = ("192.0.2.1", 1)


class QuicProgram:
    """A client or server, depending on whether `listen` or `connect` comes first."""

    def __init__(self) -> None:
        self._loop = asyncio.new_event_loop()
        self._caller = Caller(self._send)
        self._one_way: list[tuple[int, float]] = []
        self._connection: _Peer | None = None

    def listen(self, answer_bytes: int = HEADER.size) -> int:
        """Serve on a free UDP port of loopback, and return it."""

        def make(*arguments: Any, **options: Any) -> _Peer:
            return _Peer(self._on_request, *arguments, answer_bytes=answer_bytes, **options)

        async def start() -> int:
            server = await listen("127.0.0.1", 0, configuration=_server(), create_protocol=make)
            assert server._transport is not None
            return int(server._transport.get_extra_info("sockname")[1])

        return self._in_thread(start())

    def connect(self, host: str, port: int) -> None:
        """Connect to a server."""

        def make(*arguments: Any, **options: Any) -> _Peer:
            return _Peer(self._caller.answered, *arguments, answer_bytes=None, **options)

        self._context = connect(host, port, configuration=_client(), create_protocol=make)

        async def start() -> _Peer:
            protocol = await self._context.__aenter__()
            assert isinstance(protocol, _Peer)
            return protocol

        self._connection = self._in_thread(start())

    def call(self, **plan: Any) -> dict[str, Any]:
        """Send a plan's requests."""
        return self._caller.call(Plan(**plan))

    def take_one_way(self) -> list[tuple[int, float]]:
        """Return number and one-way seconds of every request since the last call."""
        taken, self._one_way = self._one_way, []
        return taken

    def usage(self) -> dict[str, float]:
        """Return processor seconds and peak of resident bytes."""
        return usage()

    def in_memory(self, size: int, count: int) -> list[float]:
        """Return the seconds for each of `count` messages between two connections of this process, without sockets."""
        client, server = _joined()
        payload = os.urandom(size)
        return [_deliver(client, server, payload) for _ in range(count)]

    def close(self) -> None:
        """End; the loop's thread is a daemon."""

    def _send(self, _number: int, data: bytes) -> None:
        assert self._connection is not None
        self._loop.call_soon_threadsafe(self._connection.send, data)

    def _on_request(self, header: bytes, now: float) -> None:
        number, sent = HEADER.unpack_from(header)
        self._one_way.append((number, now - sent))

    def _in_thread(self, start: Coroutine[Any, Any, _T]) -> _T:
        threading.Thread(target=self._loop.run_forever, daemon=True).start()
        return asyncio.run_coroutine_threadsafe(start, self._loop).result(START_TIMEOUT_S)


class _Peer(QuicConnectionProtocol):
    """Collects streams; passes on each whole message's header, and answers it if `answer_bytes` says so."""

    def __init__(
        self, on_message: Callable[[bytes, float], None], *arguments: Any, answer_bytes: int | None, **options: Any
    ) -> None:
        super().__init__(*arguments, **options)
        self._on_message = on_message
        self._answer_bytes = answer_bytes
        self._streams: dict[int, bytearray] = {}

    def send(self, data: bytes) -> None:
        """Send a message on a stream of its own."""
        self._quic.send_stream_data(self._quic.get_next_available_stream_id(), data, end_stream=True)
        self.transmit()

    def quic_event_received(self, event: QuicEvent) -> None:
        """See aioquic."""
        if not isinstance(event, StreamDataReceived):
            return
        data = self._streams.setdefault(event.stream_id, bytearray())
        data += event.data
        if event.end_stream:
            message = bytes(self._streams.pop(event.stream_id))
            self._on_message(message[: HEADER.size], time.monotonic())
            if self._answer_bytes is not None:
                self._quic.send_stream_data(event.stream_id, message[: self._answer_bytes], end_stream=True)
                self.transmit()


def _client() -> QuicConfiguration:
    configuration = QuicConfiguration(
        is_client=True, alpn_protocols=_ALPN, max_data=_WINDOW_BYTES, max_stream_data=_WINDOW_BYTES
    )
    configuration.verify_mode = ssl.CERT_NONE
    return configuration


def _server() -> QuicConfiguration:
    configuration = QuicConfiguration(
        is_client=False, alpn_protocols=_ALPN, max_data=_WINDOW_BYTES, max_stream_data=_WINDOW_BYTES
    )
    key = ec.generate_private_key(ec.SECP256R1())
    name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, "bench")])
    now = datetime.datetime.now(datetime.UTC)
    day = datetime.timedelta(days=1)
    builder = x509.CertificateBuilder().subject_name(name).issuer_name(name).public_key(key.public_key())
    builder = builder.serial_number(1).not_valid_before(now - day).not_valid_after(now + day)
    configuration.certificate = builder.sign(key, hashes.SHA256())
    configuration.private_key = key
    return configuration


def _joined() -> tuple[QuicConnection, QuicConnection]:
    client = QuicConnection(configuration=_client())
    server = QuicConnection(
        configuration=_server(), original_destination_connection_id=client.original_destination_connection_id
    )
    client.connect(_MEMORY_ADDRESS, now=time.monotonic())
    ready = 0
    while ready < 2:
        for side, other in ((client, server), (server, client)):
            _transfer(side, other)
            while (event := other.next_event()) is not None:
                ready += isinstance(event, ProtocolNegotiated)
    for _ in range(3):  # what is left of the handshake
        _transfer(client, server)
        _transfer(server, client)
    return client, server


def _transfer(sender: QuicConnection, receiver: QuicConnection) -> int:
    datagrams = sender.datagrams_to_send(now=time.monotonic())
    for data, _ in datagrams:
        receiver.receive_datagram(data, _MEMORY_ADDRESS, now=time.monotonic())
    return len(datagrams)


def _deliver(sender: QuicConnection, receiver: QuicConnection, payload: bytes) -> float:
    start = time.perf_counter()
    sender.send_stream_data(sender.get_next_available_stream_id(), payload, end_stream=True)
    while True:
        moved = _transfer(sender, receiver)
        while (event := receiver.next_event()) is not None:
            if isinstance(event, StreamDataReceived) and event.end_stream:
                took = time.perf_counter() - start
                _transfer(receiver, sender)
                return took
        if not moved + _transfer(receiver, sender):
            for side in (sender, receiver):  # only a timer, such as the pacer's or a delayed ack's, makes progress
                side.handle_timer(now=max(time.monotonic(), side.get_timer() or 0.0))


if __name__ == "__main__":
    serve(QuicProgram())
