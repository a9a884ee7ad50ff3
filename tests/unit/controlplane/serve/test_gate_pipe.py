"""One end of the gate's pipe, over real TLS."""

from __future__ import annotations

import asyncio
import socket
import ssl
import struct
from typing import TYPE_CHECKING

import pytest

from plr.controlplane.ca import Authority
from plr.controlplane.serve.gate_pipe import PipeEnd
from plr.protos.model.ids import NodeName
from plr.protos.trust.identity import IdentityRole

if TYPE_CHECKING:
    from pathlib import Path

LOST = 5
TURNS = 100_000


def contexts(folder: Path) -> tuple[ssl.SSLContext, ssl.SSLContext]:
    """Of a server and a client that does not care who it is."""
    issued = Authority.create().issue(NodeName("control"), IdentityRole.CONTROL_PLANE)
    (folder / "cert.pem").write_bytes(issued.certificate_pem)
    (folder / "key.pem").write_bytes(issued.key_pem)
    server, client = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER), ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    server.load_cert_chain(folder / "cert.pem", folder / "key.pem")
    client.check_hostname, client.verify_mode = False, ssl.CERT_NONE
    return server, client


@pytest.mark.audit("ops-16")
def test_whether_something_is_unread_can_be_asked_while_the_connection_is_lost(tmp_path: Path) -> None:
    """Asked in each turn of the loop, as for a lease: TLS loses the connection a turn before we are told."""
    server, client = contexts(tmp_path)
    connected_ends: asyncio.Queue[PipeEnd] = asyncio.Queue()

    class Watched(PipeEnd):
        def connection_made(self, transport: asyncio.BaseTransport) -> None:
            super().connection_made(transport)
            connected_ends.put_nowait(self)

    def connect(port: int) -> ssl.SSLSocket:
        connected = client.wrap_socket(socket.create_connection(("127.0.0.1", port)))
        connected.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        return connected

    async def lose_some() -> int:
        """How many had a turn in which the socket was gone and nobody had told us."""
        loop = asyncio.get_running_loop()
        listening = await loop.create_server(Watched, "127.0.0.1", 0, ssl=server)
        port = listening.sockets[0].getsockname()[1]
        seen = 0
        for _ in range(LOST):
            connected = await loop.run_in_executor(None, connect, port)
            end = await connected_ends.get()
            end.transport.resume_reading()
            connected.close()
            for _ in range(TURNS):
                if end.lost:
                    break
                seen += end.transport.get_extra_info("socket") is None
                assert end.unread() in (False, True)
                await asyncio.sleep(0)
            assert end.lost
        listening.close()
        return seen

    assert asyncio.run(lose_some()) > 0


@pytest.mark.audit("ops-3")
def test_who_is_closed_twice_and_does_not_go_can_still_be_aborted(tmp_path: Path) -> None:
    """As whoever is refused: gRPC ends its side, and the gate has no patience with the other."""
    server, client = contexts(tmp_path)
    connected_ends: asyncio.Queue[PipeEnd] = asyncio.Queue()

    class Watched(PipeEnd):
        def connection_made(self, transport: asyncio.BaseTransport) -> None:
            super().connection_made(transport)
            connected_ends.put_nowait(self)

    async def close_twice() -> None:
        gone = asyncio.Event()
        loop = asyncio.get_running_loop()
        listening = await loop.create_server(
            lambda: Watched(gone.set), "127.0.0.1", 0, ssl=server, ssl_shutdown_timeout=3600.0
        )
        port = listening.sockets[0].getsockname()[1]

        def connect() -> ssl.SSLSocket:
            return client.wrap_socket(socket.create_connection(("127.0.0.1", port)))

        connected = await loop.run_in_executor(None, connect)
        end = await connected_ends.get()
        end.close()
        end.close()
        for _ in range(10):
            await asyncio.sleep(0)
        assert not gone.is_set(), "the other side has not answered"
        end.abort()
        async with asyncio.timeout(30.0):
            await gone.wait()
        # As by a timer that was set when it was refused.
        end.close()
        end.abort()
        connected.close()
        listening.close()

    asyncio.run(close_twice())
