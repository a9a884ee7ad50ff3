"""Our STUN client against coturn's server, coturn's client against our server, and ours against ours."""

from __future__ import annotations

import asyncio
import contextlib
import random
import select
import shutil
import socket
import subprocess
import sys
import threading
import time
from typing import TYPE_CHECKING

import pytest

from plr.controlplane.core.stun.responder import StunOutcome
from plr.controlplane.serve.stun_server import SHARE, StunServer, start_stun_server
from plr.protos.stun.codec import MessageClass, StunMessage, decode, encode
from plr.sidecar.core.stun.client import StunClient
from plr.sidecar.core.stun.events import Mapped, StunEvent
from tests.support.free_ports import free_port

if TYPE_CHECKING:
    from collections import Counter
    from collections.abc import Awaitable, Callable, Iterator
    from pathlib import Path

Address = tuple[str, int]
HOSTS = {4: "127.0.0.1", 6: "::1"}
PATIENCE_S = 30.0


def udp_socket(family: int, host: str) -> socket.socket:
    sock = socket.socket(socket.AF_INET if family == 4 else socket.AF_INET6, socket.SOCK_DGRAM)
    sock.bind((host, 0))
    sock.setblocking(False)
    return sock


def learn(server: Address, family: int, local_host: str) -> tuple[StunEvent, Address]:
    """Drive a client core over a real socket until its first event; that and the socket's own address."""
    client = StunClient([server], random.SystemRandom(), software="plr test")
    with udp_socket(family, local_host) as sock:
        client.start(time.monotonic())
        patience = time.monotonic() + PATIENCE_S
        while time.monotonic() < patience:
            for data, address in client.datagrams_to_send():
                sock.sendto(data, address)
            timer = client.next_timer()
            assert timer is not None
            wait_s = max(0.0, min(timer, patience) - time.monotonic())
            if select.select([sock], [], [], wait_s)[0]:
                data, peer = sock.recvfrom(2048)
                assert client.receive_datagram(data, (peer[0], peer[1]), time.monotonic())
            else:
                client.handle_timer(time.monotonic())
            event = client.next_event()
            if event is not None:
                assert not client.drops
                return event, sock.getsockname()[:2]
    raise AssertionError(f"no event from the client in {PATIENCE_S} s")


@pytest.fixture(scope="module")
def coturn_port(tmp_path_factory: pytest.TempPathFactory) -> Iterator[int]:
    """A coturn that serves STUN only, on loopback, with nothing of it outside the test's own folder."""
    assert shutil.which("turnserver"), "Debian's package coturn is needed"
    folder: Path = tmp_path_factory.mktemp("coturn")
    port = free_port(socket.SOCK_DGRAM)
    config = folder / "turnserver.conf"
    config.write_text(
        "\n".join(
            [
                f"listening-port={port}",
                *(f"listening-ip={host}" for host in HOSTS.values()),
                "stun-only",
                "no-tcp",
                "no-tls",
                "no-dtls",
                "no-cli",
                "fingerprint",
                "log-file=stdout",
                f"pidfile={folder}/pid",
                f"userdb={folder}/db",
                "",
            ]
        )
    )
    with (folder / "log").open("w") as log:
        process = subprocess.Popen(["turnserver", "-c", str(config)], stdout=log, stderr=log, cwd=folder)
        try:
            yield port
        finally:
            process.kill()
            process.wait()


@pytest.mark.parametrize("family", [4, 6])
def test_our_client_learns_its_address_from_coturn(coturn_port: int, family: int) -> None:
    # While coturn still starts, the client's own retransmission does the waiting.
    server = (HOSTS[family], coturn_port)
    event, own = learn(server, family, HOSTS[family])
    assert event == Mapped(family, own, server)


def with_server(hosts: str | list[str], use: Callable[[StunServer], Awaitable[None]]) -> Counter[StunOutcome]:
    """Run `use` beside a server of ours on a free port; what the server counted."""

    async def run() -> Counter[StunOutcome]:
        server = await start_stun_server(hosts, 0, software="plr test")
        try:
            await use(server)
        finally:
            server.close()
        assert server.send_failures == 0
        assert server.receive_failures == 0
        return server.outcomes

    return asyncio.run(run())


@pytest.mark.parametrize("family", [4, 6])
def test_coturns_client_learns_its_address_from_our_server(family: int) -> None:
    assert shutil.which("turnutils_stunclient"), "Debian's package coturn is needed"

    async def use(server: StunServer) -> None:
        process = await asyncio.create_subprocess_exec(
            "turnutils_stunclient",
            *("-p", str(server.addresses[0][1])),
            HOSTS[family],
            stdout=asyncio.subprocess.PIPE,
            stderr=asyncio.subprocess.STDOUT,
        )
        try:
            async with asyncio.timeout(PATIENCE_S):
                output, _ = await process.communicate()
        finally:
            with contextlib.suppress(ProcessLookupError):
                process.kill()
        assert process.returncode == 0, output
        assert f"IPv{family}. UDP reflexive addr: {HOSTS[family]}:".encode() in output

    outcomes = with_server([HOSTS[family]], use)
    assert outcomes[StunOutcome.ANSWERED] >= 1
    assert set(outcomes) == {StunOutcome.ANSWERED}


@pytest.mark.parametrize("family", [4, 6])
def test_our_client_learns_its_address_from_our_server(family: int) -> None:
    async def use(server: StunServer) -> None:
        address = (HOSTS[family], server.addresses[0][1])
        event, own = await asyncio.to_thread(learn, address, family, HOSTS[family])
        assert event == Mapped(family, own, address)

    assert with_server("", use) == {StunOutcome.ANSWERED: 1}


def ask(server: Address, data: bytes) -> tuple[bytes, Address]:
    with udp_socket(4, "127.0.0.1") as sock:
        sock.setblocking(True)
        sock.settimeout(PATIENCE_S)
        sock.sendto(data, server)
        answer, peer = sock.recvfrom(2048)
    return answer, (peer[0], peer[1])


def test_the_answer_comes_from_the_address_that_was_asked() -> None:
    # A wildcard socket left to itself would answer from 127.0.0.1, and no NAT would let that through.
    async def use(server: StunServer) -> None:
        asked = ("127.0.0.77", server.addresses[0][1])
        _, answered_from = await asyncio.to_thread(ask, asked, encode(StunMessage(MessageClass.REQUEST, bytes(12))))
        assert answered_from == asked

    with_server("0.0.0.0", use)


def test_garbage_is_counted_and_the_server_goes_on() -> None:
    request = encode(StunMessage(MessageClass.REQUEST, bytes(12)))

    def send_all(server: Address) -> bytes:
        with udp_socket(4, "127.0.0.1") as sock:
            for data in (b"", b"\xd1" * 64, request[:-1], request + b"\0", bytes(9000)):
                sock.sendto(data, server)
        return ask(server, request)[0]

    async def use(server: StunServer) -> None:
        answer = await asyncio.to_thread(send_all, server.addresses[0])
        assert decode(answer).message_class is MessageClass.SUCCESS

    assert with_server("127.0.0.1", use) == {
        StunOutcome.NOT_STUN: 4,
        StunOutcome.MALFORMED: 1,
        StunOutcome.ANSWERED: 1,
    }


def test_a_request_too_long_to_be_one_is_not_taken_for_its_beginning() -> None:
    padded = bytes.fromhex("0001") + (2000).to_bytes(2, "big") + bytes.fromhex("2112a442") + bytes(2012)

    async def use(server: StunServer) -> None:
        with udp_socket(4, "127.0.0.1") as sock:
            sock.sendto(padded, server.addresses[0])
        await asyncio.to_thread(ask, server.addresses[0], encode(StunMessage(MessageClass.REQUEST, bytes(12))))

    assert with_server("127.0.0.1", use) == {StunOutcome.MALFORMED: 1, StunOutcome.ANSWERED: 1}


def test_closing_twice_is_fine_and_frees_the_port() -> None:
    async def run() -> None:
        first = await start_stun_server(["127.0.0.1", "::1"], 0)
        port = first.addresses[0][1]
        assert first.addresses == (("127.0.0.1", port), ("::1", port))
        first.close()
        first.close()
        second = await start_stun_server("127.0.0.1", port)
        second.close()

    asyncio.run(run())


@pytest.mark.parametrize("hosts", ["203.0.113.77", [], ["127.0.0.1", "203.0.113.77"]])
def test_an_address_that_is_not_ours_is_an_error(hosts: str | list[str]) -> None:
    async def run() -> None:
        with pytest.raises(OSError, match=r"."):
            await start_stun_server(hosts, 0)

    asyncio.run(run())


def test_a_port_in_use_is_an_error() -> None:
    async def run() -> None:
        first = await start_stun_server("127.0.0.1", 0)
        try:
            with pytest.raises(OSError, match="in use"):
                await start_stun_server("127.0.0.1", first.addresses[0][1])
        finally:
            first.close()

    asyncio.run(run())


@pytest.mark.audit("ops-19")
def test_an_answer_does_not_wait_for_the_event_loop() -> None:
    async def use(server: StunServer) -> None:
        question = encode(StunMessage(MessageClass.REQUEST, bytes(12)))
        asked = asyncio.get_running_loop().run_in_executor(None, ask, server.addresses[0], question)
        patience = time.monotonic() + PATIENCE_S
        # One turn of the loop, which computes and does not end before the answer is there.
        while server.outcomes[StunOutcome.ANSWERED] == 0:
            assert time.monotonic() < patience
        await asked

    assert with_server("127.0.0.1", use) == {StunOutcome.ANSWERED: 1}


FLOOD = """
import socket, sys, time
sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
sock.connect(("127.0.0.1", int(sys.argv[1])))
ends, sent = time.monotonic() + 1.0, 0
while time.monotonic() < ends:
    sent += sock.send(bytes(20)) == 20
print(sent)
"""


@pytest.mark.audit("ops-19")
def test_a_flood_takes_its_share_of_a_processor_and_what_is_dropped_is_counted() -> None:
    async def run() -> None:
        server = await start_stun_server("127.0.0.1", 0)
        try:
            (thread,) = (one for one in threading.enumerate() if one.name == "plr-stun")
            assert thread.ident is not None
            clock = time.pthread_getcpuclockid(thread.ident)
            before, began = time.clock_gettime(clock), time.monotonic()
            port = str(server.addresses[0][1])
            flood = await asyncio.create_subprocess_exec(
                sys.executable, "-c", FLOOD, port, stdout=asyncio.subprocess.PIPE
            )
            sent = int((await flood.communicate())[0])
            share = (time.clock_gettime(clock) - before) / (time.monotonic() - began)
            assert share < 1.2 * SHARE
            patience = time.monotonic() + PATIENCE_S
            while server.outcomes.total() + server.buffer_full < sent:
                # The kernel tells what it dropped along with what comes later.
                await asyncio.to_thread(ask, server.addresses[0], encode(StunMessage(MessageClass.REQUEST, bytes(12))))
                sent += 1
                assert time.monotonic() < patience
            assert server.outcomes.total() + server.buffer_full == sent
            assert server.buffer_full > 0
        finally:
            server.close()

    asyncio.run(run())
