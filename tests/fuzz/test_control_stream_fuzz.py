"""Bytes of every kind at the control plane's port, from strangers and from a member of the fleet: it stands, and keeps
serving the others without growing."""

from __future__ import annotations

import contextlib
import queue
import random
import socket
import ssl
import time
from typing import TYPE_CHECKING, Any

import grpc
import psutil
import pytest

from lab.attacker.control_client import CONNECT
from lab.attacker.junk import mangled, noise
from plr.protos.convert import sidecar_message_to_proto
from plr.protos.model.ids import NodeName, Role
from plr.protos.model.members import CandidateSet, ServiceSet
from plr.protos.model.report import Report
from plr.protos.model.stream import Drain, Heartbeat
from plr.protos.trust.identity import CONTROL_PLANE_DNS, IdentityRole
from tests.support.control_plane_process import Secured, cloud, open_channel, robot
from tests.support.registrations import registration
from tests.support.samples import histogram, interfaces, latency, offer, path, use
from tests.support.secured_control_plane import SecuredControlPlane

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from plr.controlplane.ca import Issued

MB = 1e6
DATAGRAMS_A_MESSAGE = 100
"""`--fuzz-datagrams` counts datagrams; a stream's message costs a hundred times as much."""
MESSAGES_A_STREAM = 20
STREAMS_A_MEMBER = 20
"""Each has its share of registrations, and one beyond it is refused: another one goes on."""
LINES = 21
GROWTH_BYTES = 24 * MB
PREFACE = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n"
CLIENT_HELLO = bytes.fromhex("1603010200010001fc0303")
REFUSALS = {
    grpc.StatusCode.OK,
    grpc.StatusCode.ABORTED,
    grpc.StatusCode.ALREADY_EXISTS,
    grpc.StatusCode.CANCELLED,
    grpc.StatusCode.DEADLINE_EXCEEDED,
    grpc.StatusCode.FAILED_PRECONDITION,
    grpc.StatusCode.INVALID_ARGUMENT,
    grpc.StatusCode.PERMISSION_DENIED,
    grpc.StatusCode.RESOURCE_EXHAUSTED,
}
"""How a stream may end. UNKNOWN would be an exception that nobody expected."""


class Fleet:
    """A secured control plane, and certificates for whoever wants to talk to it."""

    def __init__(self, folder: Path) -> None:
        self.plane = SecuredControlPlane(folder)
        self.authority = self.plane.authority
        self.folder = folder / "fuzzer"
        self.authority.write_tls_dir(self.folder, "fuzzer", IdentityRole.ROBOT)
        self._members = 0
        self.host, port = self.plane.address.rsplit(":", 1)
        self.port = int(port)
        self._process = psutil.Process(self.plane._process.pid)
        self._have_solver_loaded()

    def _have_solver_loaded(self) -> None:
        """The first plan makes the control plane load it, some 40 MB, which are not to be taken for growth."""
        a, r = self.plane.member("cloud-a", IdentityRole.CLOUD), self.plane.member("robot-1")
        with cloud(self.plane.address, "cloud-a", a), robot(self.plane.address, "robot-1", r) as user:
            user.mapping("cloud-a", "cloud-a")

    def another(self) -> tuple[NodeName, Issued]:
        """A member that has not registered yet."""
        self._members += 1
        name = NodeName(f"member-{self._members}")
        return name, self.authority.issue(name, IdentityRole.ROBOT)

    def channel(self, member: Issued) -> grpc.Channel:
        return open_channel(self.plane.address, Secured(member, self.authority.ca_pem))

    def resident(self) -> int:
        return int(self._process.memory_info().rss)

    def assert_fine(self) -> None:
        """It lets a member in, and has nothing to complain of."""
        name, member = self.another()
        with self.channel(member) as channel:
            code, answers = talk(channel, [registration(member, name, Role.ROBOT)], wait_for=1)
        assert answers, code
        assert [line for line in self.plane.lines if "Traceback" in line or " ERROR " in line] == []


@pytest.fixture(scope="module")
def fleet(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Fleet]:
    one = Fleet(tmp_path_factory.mktemp("fleet"))
    with one.plane:
        yield one
        one.plane.stop_flawless()


def talk(channel: grpc.Channel, messages: list[bytes], wait_for: int = 0) -> tuple[grpc.StatusCode, list[bytes]]:
    """Send messages on one stream; returns how it ended and what came."""
    outgoing: queue.SimpleQueue[bytes | None] = queue.SimpleQueue()
    for message in messages:
        outgoing.put(message)
    if not wait_for:
        outgoing.put(None)
    open_stream: Any = channel.stream_stream(CONNECT)
    call = open_stream(iter(outgoing.get, None), timeout=20.0)
    answers: list[bytes] = []
    try:
        for answer in call:
            answers.append(answer)
            if 0 < wait_for <= len(answers):
                call.cancel()
    except grpc.RpcError:
        pass
    outgoing.put(None)
    return call.code(), answers


def sane(rng: random.Random, register: bytes) -> bytes:
    """A message as a sidecar may send it."""
    measured = histogram(0.01, 0.02, times=rng.randint(1, 5))
    wlan = path("wlan0", "cloud", rtt=measured)
    messages = (
        CandidateSet(interfaces("wlan0", "wwan0")),
        ServiceSet((offer(),), (use(),)),
        Report((latency("wlan0", "cloud", measured),), (wlan,)),
        Heartbeat(),
        Drain(),
    )
    made = rng.randrange(len(messages) + 1)
    return register if made == len(messages) else sidecar_message_to_proto(messages[made]).SerializeToString()


def mutated(message: bytes, rng: random.Random) -> bytes:
    """The message, or what is left of it."""
    return rng.choice((message, mangled(message, rng), mangled(message, rng), noise(rng)))


@pytest.mark.timeout(3600)
def test_a_member_that_sends_anything(fleet: Fleet, fuzz_datagrams: int) -> None:
    rng = random.Random(1)
    fleet.assert_fine()
    codes = set()
    before = 0
    began = time.monotonic()
    count = max(3 * LINES, fuzz_datagrams // DATAGRAMS_A_MESSAGE // MESSAGES_A_STREAM)
    for begin in range(0, count, STREAMS_A_MEMBER):
        name, member = fleet.another()
        with fleet.channel(member) as channel:
            for number in range(begin, min(begin + STREAMS_A_MEMBER, count)):
                register = registration(member, name, Role.ROBOT)
                first = mutated(register, rng) if number % 4 == 0 else register
                code, _ = talk(channel, [first, *(mutated(sane(rng, register), rng) for _ in range(MESSAGES_A_STREAM))])
                codes.add(code)
                if number == count // 2:
                    before = fleet.resident()
    assert codes <= REFUSALS
    assert grpc.StatusCode.INVALID_ARGUMENT in codes
    told = [line for line in fleet.plane.lines if " ended: " in line]
    assert len(told) <= LINES + time.monotonic() - began, "a member cannot fill the disk with log lines"
    assert fleet.resident() - before < GROWTH_BYTES
    fleet.assert_fine()


@pytest.mark.timeout(600)
def test_strangers_that_send_anything(fleet: Fleet, fuzz_datagrams: int) -> None:
    """Raw bytes to the port, and raw bytes inside TLS from one who has a certificate."""
    rng = random.Random(2)
    fleet.assert_fine()
    before = fleet.resident()
    for _ in range(max(50, fuzz_datagrams // 2000)):
        with contextlib.suppress(OSError), socket.create_connection((fleet.host, fleet.port), 5.0) as plain:
            data = rng.choice((b"", PREFACE, CLIENT_HELLO)) + rng.randbytes(rng.randrange(4000))
            if rng.random() < 0.3:
                with secured(fleet, plain) as inside:
                    inside.sendall(data)
            else:
                plain.sendall(data)
    assert fleet.resident() - before < GROWTH_BYTES
    fleet.assert_fine()


def secured(fleet: Fleet, plain: socket.socket) -> ssl.SSLSocket:
    context = ssl.create_default_context(cadata=fleet.authority.ca_pem.decode())
    context.load_cert_chain(fleet.folder / "cert.pem", fleet.folder / "key.pem")
    context.set_alpn_protocols(["h2"])
    return context.wrap_socket(plain, server_hostname=CONTROL_PLANE_DNS)
