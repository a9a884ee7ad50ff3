"""The gate alone, with a server of bytes behind it: what it carries, what it bounds, what it forgets."""

from __future__ import annotations

import asyncio
import contextlib
import gc
import ssl
import time
import weakref
from collections import Counter
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import pytest

from plr.controlplane.ca import Authority
from plr.controlplane.serve import tls_gate
from plr.controlplane.serve.tls_gate import TlsGate
from plr.protos.model.ids import NodeName
from plr.protos.program.tls_files import load_tls_files
from plr.protos.trust.clock_floor import ClockFloor
from plr.protos.trust.identity import CONTROL_PLANE_DNS, IdentityRole

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable
    from pathlib import Path

PATIENCE_S = 30.0

Streams = tuple[asyncio.StreamReader, asyncio.StreamWriter]


@dataclass
class Fleet:
    """A CA, the gate's files and those of its clients."""

    folder: Path
    authority: Authority = field(default_factory=Authority.create)

    def tls_dir(self, name: str, role: IdentityRole = IdentityRole.ROBOT) -> Path:
        folder = self.folder / name
        if not folder.exists():
            self.authority.write_tls_dir(folder, name, role)
        return folder

    def client(self, name: str) -> ssl.SSLContext:
        folder = self.tls_dir(name)
        context = ssl.create_default_context(cafile=str(folder / "ca.pem"))
        context.load_cert_chain(folder / "cert.pem", folder / "key.pem")
        return context


@dataclass
class Gate:
    """A gate before a server that sends back what it gets."""

    fleet: Fleet
    port: int
    gate: TlsGate
    refused: Counter[str]
    peers: list[str]

    async def connect(self, name: str) -> Streams:
        return await asyncio.open_connection(
            "127.0.0.1", self.port, ssl=self.fleet.client(name), server_hostname=CONTROL_PLANE_DNS
        )


@contextlib.asynccontextmanager
async def opened(folder: Path) -> AsyncIterator[Gate]:
    fleet, refused, peers = Fleet(folder), Counter[str](), list[str]()

    async def echo(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        peers.append("unix-abstract:" + writer.get_extra_info("peername").removeprefix(b"\0").decode())
        with contextlib.suppress(ConnectionError):
            while data := await reader.read(1 << 16):
                writer.write(data)
                await writer.drain()
        writer.close()

    upstream = str(folder / "upstream")
    server = await asyncio.start_unix_server(echo, upstream)
    files = load_tls_files(fleet.tls_dir("control", IdentityRole.CONTROL_PLANE))
    gate = TlsGate(files, [upstream], lambda reason: refused.update([reason]), ClockFloor(time.time))
    try:
        yield Gate(fleet, gate.listen("127.0.0.1", 0), gate, refused, peers)
    finally:
        await gate.close()
        server.close()
        await asyncio.sleep(0.05)


async def until(done: Callable[[], bool]) -> None:
    async with asyncio.timeout(PATIENCE_S):
        while not done():  # noqa: ASYNC110 - what is waited for has no event
            await asyncio.sleep(0.01)


async def ended(streams: Streams) -> None:
    """Wait until the other side has ended the connection."""
    async with asyncio.timeout(PATIENCE_S):
        with contextlib.suppress(ConnectionError, ssl.SSLError):
            assert await streams[0].read(1) == b""
    streams[1].close()


def test_bytes_arrive_whole_however_slow_their_reader_is(tmp_path: Path) -> None:
    async def run() -> None:
        async with opened(tmp_path) as gate:
            reader, writer = await gate.connect("robot-1")
            sent = bytes(range(256)) * (1 << 15)
            writing = asyncio.create_task(write(writer, sent))
            # Nobody reads for a while: what is under way has to wait somewhere, and not in the gate.
            await asyncio.sleep(0.3)
            async with asyncio.timeout(PATIENCE_S):
                assert await reader.readexactly(len(sent)) == sent
            await writing
            caller = gate.gate.caller(gate.peers[0])
            assert caller is not None
            assert (caller.identity.name, caller.refusal) == ("robot-1", None)
            writer.close()
            await until(lambda: gate.gate.caller(gate.peers[0]) is None)

    asyncio.run(run())


async def write(writer: asyncio.StreamWriter, data: bytes) -> None:
    for start in range(0, len(data), 1 << 16):
        writer.write(data[start : start + (1 << 16)])
        await writer.drain()


def test_of_many_connections_of_one_name_the_oldest_ends(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tls_gate, "MAX_CONNECTIONS_PER_NAME", 2)

    async def run() -> None:
        async with opened(tmp_path) as gate:
            other = await gate.connect("robot-2")
            oldest, second, third = [await gate.connect("robot-1") for _ in range(3)]
            await ended(oldest)
            assert gate.refused == {"too_many_connections": 1}
            for reader, writer in (other, second, third):
                writer.write(b"x")
                async with asyncio.timeout(PATIENCE_S):
                    assert await reader.readexactly(1) == b"x"
                writer.close()

    asyncio.run(run())


def test_beyond_all_connections_a_further_one_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tls_gate, "MAX_TLS_CONNECTIONS", 1)

    async def run() -> None:
        async with opened(tmp_path) as gate:
            reader, writer = await gate.connect("robot-1")
            await ended(await gate.connect("robot-2"))
            assert gate.refused["too_many_connections"] == 1
            writer.write(b"x")
            assert await reader.readexactly(1) == b"x"
            writer.close()

    asyncio.run(run())


CLIENT_HELLO = b"\x16\x03\x01\x02\x00\x01"
"""Its beginning; the rest never comes."""


@pytest.mark.audit("sec-7")
@pytest.mark.parametrize("limit", ["MAX_HANDSHAKES", "MAX_HANDSHAKES_PER_SOURCE"])
def test_half_open_handshakes_make_room_oldest_first(
    limit: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tls_gate, limit, 3)

    async def run() -> None:
        async with opened(tmp_path) as gate:
            waiting = [await asyncio.open_connection("127.0.0.1", gate.port) for _ in range(3)]
            for _, writer in waiting:
                writer.write(CLIENT_HELLO)
            await until(lambda: len(gate.gate._handshakes) == 3)
            reader, writer = await gate.connect("robot-1")
            writer.write(b"x")
            assert await reader.readexactly(1) == b"x"
            await ended(waiting[0])
            assert gate.refused["too_many_handshakes"] == 1
            for _, other in (*waiting[1:], (reader, writer)):
                other.close()

    asyncio.run(run())


@pytest.mark.audit("sec-7")
def test_who_says_nothing_keeps_nobody_from_coming_in(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """An attacker behind the operator's own NAT holds as many silent connections as there is room for, and more."""
    monkeypatch.setattr(tls_gate, "MAX_SILENT_PER_SOURCE", 20)

    async def run() -> None:
        async with opened(tmp_path) as gate:
            silent = [await asyncio.open_connection("127.0.0.1", gate.port) for _ in range(50)]
            await until(lambda: gate.refused["too_many_handshakes"] == 30)
            for number in range(6):
                reader, writer = await gate.connect(f"robot-{number}")
                writer.write(b"x")
                assert await reader.readexactly(1) == b"x"
                writer.close()
            assert len(gate.gate._silent) <= 20
            for _, other in silent:
                other.close()
            await until(lambda: len(gate.gate._silent) == 0)

    asyncio.run(run())


@pytest.mark.audit("sec-7")
def test_who_never_says_anything_is_ended(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tls_gate, "HANDSHAKE_TIMEOUT_S", 0.2)

    async def run() -> None:
        async with opened(tmp_path) as gate:
            await ended(await asyncio.open_connection("127.0.0.1", gate.port))
            assert gate.refused == {"handshake_timeout": 1}
            assert len(gate.gate._silent) == len(gate.gate._handshakes) == len(gate.gate._unread) == 0

    asyncio.run(run())


@contextlib.asynccontextmanager
async def busy(gate: Gate) -> AsyncIterator[None]:
    """All places on the way are taken by one who stops within his handshake; needs MAX_ON_THE_WAY = 1."""
    _, writer = await asyncio.open_connection("127.0.0.1", gate.port)
    writer.write(CLIENT_HELLO)
    await until(lambda: gate.gate._admission.on_the_way == 1)
    yield
    writer.close()


@pytest.mark.audit("ops-16")
def test_who_came_last_is_let_in_first_and_the_next_when_that_one_is_served(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tls_gate, "MAX_ON_THE_WAY", 1)
    monkeypatch.setattr(tls_gate, "ON_THE_WAY_S", PATIENCE_S)
    names = ["robot-1", "robot-2", "robot-3"]

    async def run() -> None:
        async with opened(tmp_path) as gate:
            for name in names:
                gate.fleet.tls_dir(name)
            async with busy(gate):
                tasks = []
                for place, name in enumerate(names, 1):
                    tasks.append(asyncio.create_task(gate.connect(name)))
                    await until(lambda place=place: len(gate.gate._admission) == place)  # type: ignore[misc]
            for place in range(1, 4):
                await until(lambda place=place: len(gate.peers) == place)  # type: ignore[misc]
                assert len(gate.gate._admission) == 3 - place
                gate.gate.is_served(gate.peers[-1])
            callers = [gate.gate.caller(peer) for peer in gate.peers]
            assert [caller and caller.identity.name for caller in callers] == names[::-1]
            for task in tasks:
                (await task)[1].close()

    asyncio.run(run())


@pytest.mark.audit("ops-16")
def test_who_leaves_while_he_waits_costs_no_handshake(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tls_gate, "MAX_ON_THE_WAY", 1)
    monkeypatch.setattr(tls_gate, "ON_THE_WAY_S", PATIENCE_S)

    async def run() -> None:
        async with opened(tmp_path) as gate:
            async with busy(gate):
                waiting = [await asyncio.open_connection("127.0.0.1", gate.port) for _ in range(20)]
                for _, writer in waiting:
                    writer.write(CLIENT_HELLO)
                await until(lambda: len(gate.gate._admission) == 20)
                for _, writer in waiting[1:]:
                    writer.close()
                await until(lambda: gate.refused["gave_up"] == 19)
                assert len(gate.gate._admission) == 1
                assert len(gate.gate._handshakes) == 1
            waiting[0][1].close()

    asyncio.run(run())


@pytest.mark.audit("ops-16")
def test_of_more_than_may_wait_the_oldest_goes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tls_gate, "MAX_ON_THE_WAY", 1)
    monkeypatch.setattr(tls_gate, "ON_THE_WAY_S", PATIENCE_S)
    monkeypatch.setattr(tls_gate, "MAX_WAITING_CONNECTIONS", 3)

    async def run() -> None:
        async with opened(tmp_path) as gate, busy(gate):
            waiting = []
            for number in range(5):
                waiting.append(await asyncio.open_connection("127.0.0.1", gate.port))
                waiting[-1][1].write(CLIENT_HELLO)
                await until(
                    lambda number=number: len(gate.gate._admission) + gate.refused["too_many_handshakes"] == number + 1  # type: ignore[misc]
                )
            assert (len(gate.gate._admission), gate.refused["too_many_handshakes"]) == (3, 2)
            for oldest in waiting[:2]:
                await ended(oldest)
            for _, writer in waiting[2:]:
                writer.close()

    asyncio.run(run())


def test_a_revoked_certificates_connections_end_and_no_others(tmp_path: Path) -> None:
    async def run() -> None:
        async with opened(tmp_path) as gate:
            bad, (reader, writer) = await gate.connect("robot-1"), await gate.connect("robot-2")
            await until(lambda: len(gate.peers) == 2)
            gate.fleet.authority.revoke("robot-1")
            control = gate.fleet.tls_dir("control")
            (control / "crl.pem").write_bytes(gate.fleet.authority.crl_pem())
            gate.gate.use(load_tls_files(control))
            for name, _ in gate.gate.serials():
                gate.gate.review(name)
            judged = [gate.gate.caller(peer) for peer in gate.peers]
            assert [(c.identity.name, c.refusal and c.refusal.reason) for c in judged if c] == [
                ("robot-1", "revoked"),
                ("robot-2", None),
            ]
            await ended(bad)
            assert gate.refused == {"revoked": 1}
            writer.write(b"x")
            assert await reader.readexactly(1) == b"x"
            writer.close()

    asyncio.run(run())


@pytest.mark.audit("ops-16")
def test_the_gate_knows_of_bytes_that_nobody_has_read(tmp_path: Path) -> None:
    """In the kernel while the loop is busy, and behind the gate until the time that the asker has read to."""
    name = NodeName("robot-1")

    async def run() -> None:
        async with opened(tmp_path) as gate:
            reader, writer = await gate.connect(name)
            writer.write(b"one")
            assert await reader.readexactly(3) == b"one"
            read_at = time.monotonic()
            assert not gate.gate.has_unread(name, read_at)
            assert not gate.gate.has_unread(NodeName("nobody"), 0.0)
            before = read_at - PATIENCE_S
            assert gate.gate.has_unread(name, before), "passed on after that"
            writer.write(b"two")
            # Not a turn of the loop: it is sent, and nobody reads it.
            patience = time.monotonic() + PATIENCE_S
            while not gate.gate.has_unread(name, read_at):
                assert time.monotonic() < patience
            assert await reader.readexactly(3) == b"two"
            assert gate.gate.has_unread(name, read_at), "passed on, and for all that the gate knows not read"
            assert not gate.gate.has_unread(name, time.monotonic())
            writer.close()
            await until(lambda: not gate.gate.has_unread(name, before))

    asyncio.run(run())


@pytest.mark.audit("ops-19")
def test_an_ended_connection_is_gone_without_the_garbage_collector(tmp_path: Path) -> None:
    """What has been there for long is set aside from collections: in a cycle it would stay for ever."""

    async def run() -> None:
        async with opened(tmp_path) as gate:
            for name in ("robot-1", "robot-2"):
                reader, writer = await gate.connect(name)
                await write(writer, b"hello")
                assert await reader.readexactly(5) == b"hello"
                (connection,) = gate.gate._connections.values()
                tls = getattr(connection.outside.transport, "_ssl_protocol")  # noqa: B009 - of asyncio, and private
                left = [weakref.ref(part) for part in (connection.outside, connection.inside, tls)]
                del connection, tls
                writer.close()
                await until(lambda left=left: not any(part() for part in left))  # type: ignore[misc]

    gc.collect()
    gc.disable()
    try:
        asyncio.run(run())
    finally:
        gc.enable()
