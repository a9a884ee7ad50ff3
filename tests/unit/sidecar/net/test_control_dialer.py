"""The dialer with real sockets on loopback; gRPC is a plain socket of the test."""

from __future__ import annotations

import asyncio
import contextlib
import errno
import os
import socket
import subprocess
import sys
from typing import TYPE_CHECKING, Any

import pytest

from plr.protos.model.ids import InterfaceName
from plr.sidecar.core.base.values import PathState
from plr.sidecar.core.control import ways
from plr.sidecar.core.control.session import ControlStats
from plr.sidecar.core.control.watch import CHEAPER, GONE, SILENT, Leave, Seen
from plr.sidecar.core.control.ways import STRANGER, ControlInterface, Price, Way
from plr.sidecar.net import control_attempts, control_dialer, control_sockets
from plr.sidecar.net.control_dialer import ControlDialer

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable, Coroutine

    from plr.protos.model.ids import Address
    from plr.sidecar.net.control_dialer import ControlLine

WAIT_S = 20.0
WLAN, WWAN = InterfaceName("wlan0"), InterfaceName("wwan0")
INTERFACES = (
    ControlInterface(WLAN, frozenset({"10.0.0.2", "fd00::2"}), Price()),
    ControlInterface(WWAN, frozenset({"10.1.0.2", "fd00:1::2"}), Price(billed=True)),
)


class Echo:
    """A control plane that repeats what it is told, reached through interfaces that are all made up."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.opened: list[Way] = []
        self.tried = asyncio.Event()
        self.refuse: Callable[[Way], BaseException | None] = lambda way: None
        self.dark: set[InterfaceName | None] = set()
        self.unacked = False
        monkeypatch.setattr(control_attempts, "open_stream", self.open_stream)
        monkeypatch.setattr(control_dialer, "look", self.look)
        monkeypatch.setattr(control_dialer, "own_address", lambda sock: "10.0.0.2")

    async def __aenter__(self) -> Echo:
        self.server = await asyncio.start_server(self.serve, "127.0.0.1", 0)
        host, port = self.server.sockets[0].getsockname()[:2]
        self.real: Address = (host, port)
        return self

    async def __aexit__(self, *_: object) -> None:
        self.server.close()

    async def serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        with contextlib.suppress(OSError):
            while data := await reader.read(1 << 16):
                writer.write(data)
                await writer.drain()
        writer.close()

    def open_stream(self, way: Way) -> socket.socket:
        self.opened.append(way)
        self.tried.set()
        refused = self.refuse(way)
        if refused is not None:
            raise refused
        return _Redirected(self, way)

    def look(self, sock: socket.socket) -> Seen:
        return Seen(self.unacked, 60.0 if self.unacked else 0.0, 0.001)


class _Redirected(socket.socket):
    """Leads to the test's server, whatever address it is connected to."""

    def __init__(self, echo: Echo, way: Way) -> None:
        super().__init__(socket.AF_INET, socket.SOCK_STREAM)
        self.setblocking(False)
        self.echo, self.way = echo, way

    def connect(self, address: Any) -> None:
        if self.way.interface in self.echo.dark:
            self.bind(("127.0.0.1", 0))
            super().connect(("192.0.2.255", 9))  # answers nobody
        super().connect(self.echo.real)


def run(test: Callable[[Echo], Coroutine[Any, Any, None]], monkeypatch: pytest.MonkeyPatch) -> None:
    async def main() -> None:
        async with asyncio.timeout(WAIT_S), Echo(monkeypatch) as echo:
            await test(echo)

    asyncio.run(main())


def make(**changes: Any) -> ControlDialer:
    dialer = ControlDialer(**{"names": ("192.0.2.1:50051",), "stats": ControlStats(), **changes})
    dialer.set_interfaces(INTERFACES)
    return dialer


@contextlib.asynccontextmanager
async def connected(dialer: ControlDialer, *, last: bool = True) -> AsyncIterator[tuple[ControlLine, socket.socket]]:
    """A line with gRPC's end of it."""
    dialer.start(lambda: None)
    async with dialer.line() as line:
        with grpc_end(line) as end:
            await asyncio.get_running_loop().sock_connect(end, name_of(line))
            yield line, end
    if last:
        dialer.close()


def name_of(line: ControlLine) -> str:
    return "\0" + line.target.removeprefix("unix-abstract:")


def grpc_end(line: ControlLine) -> socket.socket:
    end = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    end.setblocking(False)
    return end


async def says(end: socket.socket, text: bytes) -> bytes:
    loop = asyncio.get_running_loop()
    await loop.sock_sendall(end, text)
    heard = b""
    while len(heard) < len(text):
        heard += await loop.sock_recv(end, 1 << 16)
    return heard


def test_bytes_pass_both_ways_over_the_best_way(monkeypatch: pytest.MonkeyPatch) -> None:
    async def test(echo: Echo) -> None:
        dialer = make()
        async with connected(dialer) as (line, end):
            text = bytes(range(256)) * 4000
            assert await says(end, text) == text
            assert line.way == Way(WLAN, ("192.0.2.1", 50051))
            assert line.describe() is None
        assert dialer.stats.connections == {"wlan0": 1}

    run(test, monkeypatch)


@pytest.mark.parametrize("turns", range(6))
def test_news_of_the_network_does_not_keep_a_line_that_is_over(turns: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever the loop's turn in which the line ends after the news: a wait that has just come true must not swallow
    its cancellation, or the sidecar stays without a control stream."""

    async def test(echo: Echo) -> None:
        async with connected(make()) as (line, end):
            await says(end, b"x")
            await asyncio.sleep(0.05)
            line.wake.set()
            for _ in range(turns):
                await asyncio.sleep(0)

    run(test, monkeypatch)


def test_a_refused_way_gives_way_to_the_next(monkeypatch: pytest.MonkeyPatch) -> None:
    async def test(echo: Echo) -> None:
        echo.refuse = lambda way: OSError(errno.ENETUNREACH, "no") if way.interface == WLAN else None
        async with connected(make()) as (line, end):
            assert await says(end, b"x") == b"x"
            assert line.way is not None
            assert line.way.interface == WWAN

    run(test, monkeypatch)


def test_when_every_way_fails_the_reasons_are_told(monkeypatch: pytest.MonkeyPatch) -> None:
    async def test(echo: Echo) -> None:
        echo.refuse = lambda way: OSError(errno.ECONNREFUSED, "no")
        async with connected(make()) as (line, end):
            why = await line.ended
            assert why == (
                "192.0.2.1:50051 over wlan0: Connection refused; 192.0.2.1:50051 over wwan0: Connection refused; "
                "192.0.2.1:50051: Connection refused"
            )
            assert await asyncio.get_running_loop().sock_recv(end, 1) == b""

    run(test, monkeypatch)


def test_a_dark_interface_does_not_hold_up_the_others(monkeypatch: pytest.MonkeyPatch) -> None:
    async def test(echo: Echo) -> None:
        echo.dark = {WLAN}
        async with connected(make()) as (line, end):
            assert await says(end, b"x") == b"x"
            assert line.way is not None
            assert line.way.interface != WLAN

    run(test, monkeypatch)


def test_strangers_are_turned_away(monkeypatch: pytest.MonkeyPatch) -> None:
    """Another process of the same user, even."""

    async def test(echo: Echo) -> None:
        dialer = make()
        dialer.start(lambda: None)
        async with dialer.line() as line:
            intruder = (
                "import socket, sys\n"
                "s = socket.socket(socket.AF_UNIX)\n"
                "s.connect('\\0' + sys.argv[1])\n"
                "try: s.sendall(b'hello'); sys.exit(len(s.recv(9)))\n"
                "except OSError: sys.exit(0)\n"
            )
            argv = [sys.executable, "-c", intruder, name_of(line)[1:]]
            assert await asyncio.to_thread(subprocess.call, argv) == 0
            assert echo.opened == []
            with grpc_end(line) as end:
                await asyncio.get_running_loop().sock_connect(end, name_of(line))
                assert await says(end, b"x") == b"x"
                with grpc_end(line) as second, pytest.raises(ConnectionRefusedError):
                    await asyncio.get_running_loop().sock_connect(second, name_of(line))
        assert dialer.stats.dial_drops[STRANGER] == 1
        dialer.close()

    run(test, monkeypatch)


def test_without_the_right_to_bind_it_follows_the_routing_table_and_says_so_once(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    async def test(echo: Echo) -> None:
        def refuse(way: Way) -> BaseException | None:
            return None if way.interface is None else control_sockets.NotAllowedError(errno.EPERM, "no")

        echo.refuse = refuse
        dialer = make()
        for _ in range(2):
            async with connected(dialer) as (line, end):
                assert await says(end, b"x") == b"x"
                assert line.way == Way(None, ("192.0.2.1", 50051))

    run(test, monkeypatch)
    assert caplog.text.count("follows the routing table") == 1


def test_it_is_left_when_its_interface_is_gone(monkeypatch: pytest.MonkeyPatch) -> None:
    async def test(echo: Echo) -> None:
        dialer = make()
        async with connected(dialer) as (line, end):
            await says(end, b"x")
            dialer.set_interfaces(INTERFACES[1:])
            leave = await line.ended
            assert isinstance(leave, Leave)
            assert leave.cause == GONE
            assert await asyncio.get_running_loop().sock_recv(end, 1) == b""
        assert dialer.stats.connections_left == {GONE: 1}

    run(test, monkeypatch)


def test_silence_is_doubted_then_confirmed_by_the_data_plane_and_avoided(monkeypatch: pytest.MonkeyPatch) -> None:
    async def test(echo: Echo) -> None:
        asked: list[InterfaceName] = []

        def check_paths(interface: InterfaceName) -> None:
            asked.append(interface)
            dialer.set_paths({WLAN: PathState.UNSTABLE, WWAN: PathState.UP})

        dialer = make(check_paths=check_paths)
        dialer.set_paths({WLAN: PathState.UP, WWAN: PathState.UP})
        async with connected(dialer) as (line, end):
            await says(end, b"x")
            echo.unacked = True
            await asyncio.get_running_loop().sock_sendall(end, b"y")
            leave = await line.ended
            assert isinstance(leave, Leave)
            assert leave.cause == SILENT
        assert asked == [WLAN]
        echo.unacked = False
        async with connected(dialer) as (line, end):
            await says(end, b"x")
            assert line.way is not None
            assert line.way.interface == WWAN

    run(test, monkeypatch)


def test_the_cheaper_interface_is_connected_before_the_dearer_one_is_left(monkeypatch: pytest.MonkeyPatch) -> None:
    async def test(echo: Echo) -> None:
        echo.refuse = lambda way: OSError(errno.EHOSTUNREACH, "no") if way.interface == WLAN else None
        monkeypatch.setattr(ways, "FAILED_FIRST_S", 0.2)
        dialer = make()
        dialer.ways._states[WLAN].well_s = 0.0
        both = {WLAN: PathState.UP, WWAN: PathState.UP}
        async with connected(dialer, last=False) as (line, end):
            await says(end, b"x")
            echo.tried.clear()
            dialer.set_paths(both)
            await echo.tried.wait()
            assert await says(end, b"x") == b"x"
            assert not line.ended.done(), "nobody answers there: it stays"
            echo.refuse = lambda way: None
            leave = await line.ended
            assert isinstance(leave, Leave)
            assert leave.cause == CHEAPER
        opened = len(echo.opened)
        async with connected(dialer) as (line, end):
            await says(end, b"x")
            assert line.way is not None
            assert line.way.interface == WLAN
        assert len(echo.opened) == opened, "it takes the connection that was made in advance"

    run(test, monkeypatch)


def test_a_way_that_leads_to_no_control_plane_is_tried_last(monkeypatch: pytest.MonkeyPatch) -> None:
    """A captive portal takes every connection."""

    async def test(echo: Echo) -> None:
        dialer = make()
        async with connected(dialer) as (line, end):
            await says(end, b"x")
            line.over(welcomed=False, refused=False)
        async with connected(dialer) as (line, end):
            await says(end, b"x")
            assert line.way is not None
            assert line.way.interface == WWAN
            line.let_in()
            line.over(welcomed=True, refused=False)

    run(test, monkeypatch)


def test_addresses_that_worked_are_kept_for_when_their_name_cannot_be_looked_up(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    async def test(echo: Echo) -> None:
        remembered: list[tuple[Address, ...]] = []
        monkeypatch.setattr(socket, "getaddrinfo", unknown)
        dialer = make(names=("cp.example:50051",), kept=(("192.0.2.7", 50051),), remember=remembered.append)
        async with connected(dialer) as (line, end):
            await says(end, b"x")
            assert line.way is not None
            assert line.way.address == ("192.0.2.7", 50051)
            line.let_in()
        assert remembered == [], "nothing new"
        dialer._use((("192.0.2.8", 50051),))
        dialer.let_in(Way(WLAN, ("192.0.2.8", 50051)))
        assert remembered == [(("192.0.2.8", 50051), ("192.0.2.7", 50051))]

    run(test, monkeypatch)


def test_a_name_without_any_address_is_waited_for(monkeypatch: pytest.MonkeyPatch) -> None:
    async def test(echo: Echo) -> None:
        monkeypatch.setattr(socket, "getaddrinfo", unknown)
        hopes: list[None] = []
        dialer = make(names=("cp.example:50051",))
        async with connected(dialer) as (line, end):
            dialer._hope = lambda: hopes.append(None)
            await asyncio.sleep(0.05)
            assert line.describe() == "no address of cp.example:50051 is known"
            dialer._use((("192.0.2.8", 50051),))
            assert await says(end, b"x") == b"x"
        assert hopes

    run(test, monkeypatch)


def unknown(*_: Any, **__: Any) -> list[Any]:
    raise socket.gaierror("no such host")


def test_many_streams_leave_nothing_behind(monkeypatch: pytest.MonkeyPatch) -> None:
    async def test(echo: Echo) -> None:
        dialer = make()
        dialer.start(lambda: None)
        open_before: set[str] = set()
        for number in range(60):
            echo.dark = {WLAN} if number % 3 == 0 else set()
            async with dialer.line() as line:
                if number % 5:
                    with grpc_end(line) as end:
                        await asyncio.get_running_loop().sock_connect(end, name_of(line))
                        if number % 7:
                            await says(end, b"x")
            await asyncio.sleep(0.02)
            if number == 9:
                open_before = set(os.listdir("/proc/self/fd"))
        await asyncio.sleep(0.1)
        assert len(os.listdir("/proc/self/fd")) <= len(open_before) + 4, "the server's ends close a moment later"
        assert len(asyncio.all_tasks()) <= 5
        dialer.close()

    run(test, monkeypatch)


def test_the_kernel_tells_how_a_connection_fares() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        with control_sockets.open_stream(Way(None, server.getsockname())) as sock:
            with contextlib.suppress(BlockingIOError):
                sock.connect(server.getsockname())
            accepted, _ = server.accept()
            with accepted:
                sock.send(b"x")
                assert accepted.recv(1) == b"x"
                accepted.send(b"y")
                sock.setblocking(True)
                assert sock.recv(1) == b"y"
                seen = control_sockets.look(sock)
                assert not seen.unacked
                assert 0.0 <= seen.quiet_s < WAIT_S
                assert 0.0 < seen.rtt_s < WAIT_S
                assert control_sockets.own_address(sock) == "127.0.0.1"


def test_an_interface_that_does_not_exist_is_an_error_of_its_own_kind() -> None:
    with pytest.raises(OSError, match="No such device"):
        control_sockets.open_stream(Way(InterfaceName("nowhere0"), ("::1", 1)))
