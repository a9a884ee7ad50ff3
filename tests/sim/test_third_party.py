"""Nobody makes a sidecar send much to somebody who never asked for it: "V", which stands for the victim's address.

In simulated time, with the real cores and hostile members or strangers whose datagrams the tests write themselves.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import pytest

from lab.simulated.mesh import SERVICE, TYPE, Mesh, rule
from plr.protos.model.ids import InterfaceId, InterfaceName, Role
from plr.protos.model.members import Candidate, CandidateKind
from plr.sidecar.core.base.request_id import make_request_id
from plr.sidecar.core.base.values import PathState, Priority
from plr.sidecar.core.link.path_table import UNPROVEN_BYTES, UNPROVEN_BYTES_PER_S
from plr.sidecar.core.path.address import AMPLIFICATION
from plr.sidecar.core.wire import frame
from plr.sidecar.core.wire.messages import RequestMessage, encode_message

if TYPE_CHECKING:
    from lab.simulated.mesh import Node
    from plr.protos.model.ids import Address
    from plr.protos.model.members import Peer
    from plr.sidecar.core.path.path import Path

pytestmark = pytest.mark.audit("sec-5")

VICTIM = ("V", 53)
WLAN0, ETH0 = InterfaceName("wlan0"), InterfaceName("eth0")


@dataclass
class Received:
    """What arrived at the victim."""

    datagrams: int = 0
    bytes: int = 0


def watch(mesh: Mesh) -> Received:
    received = Received()

    def tap(_source: Address, destination: Address, data: bytes) -> None:
        if destination[0] == VICTIM[0]:
            received.datagrams += 1
            received.bytes += len(data)

    mesh.tap = tap
    mesh.unreachable.add(VICTIM[0])
    return received


class Insider:
    """A robot with good keys, whose own program is silent: what it sends is written here, with V as its source."""

    def __init__(self, *, answer_bytes: int) -> None:
        self.mesh = Mesh(1)
        self.robot, self.cloud = self.mesh.robot("wlan0"), self.mesh.cloud("cloud-a")
        self.mesh.push_views()
        self.mesh.run(3.0)
        self.cloud.answer = lambda _request: bytes(answer_bytes)
        (self.path,) = self.robot.links[WLAN0]._table.paths.values()
        for wire in self.mesh.all_wires_of("robot.wlan0"):
            wire.cut = True
        self.received = watch(self.mesh)
        self.sent = 0

    @property
    def path_at_cloud(self) -> Path:
        (path,) = self.cloud.links[ETH0]._table.paths.values()
        return path

    def send(self, *frames: bytes, source: Address = VICTIM) -> None:
        number = self.path.recovery.take_numbers()
        datagram = self.robot.links[WLAN0]._builder._sealed(self.path, number, self.mesh.now, *frames)
        self.sent += len(datagram)
        self.mesh.inject(source, self.cloud.address(ETH0), datagram)

    def request(self, number: int, source: Address = VICTIM) -> None:
        request_id = make_request_id(self.robot.session, b"guid", 1000 + number)
        encoded = encode_message(RequestMessage(request_id, 0, Priority.NORMAL, 1.0, 60.0, SERVICE, TYPE, b"q" * 32))
        body = encoded.head + bytes(encoded.payload)
        self.send(frame.encode_fragment_head(10_000 + number, len(body), 1024, 0), body, source=source)


def test_at_most_three_times_what_came_from_there_goes_to_an_address_that_is_not_proven() -> None:
    insider = Insider(answer_bytes=8 << 20)
    for number in range(10):
        insider.request(number)
        insider.mesh.run(1.0)
    assert 0 < insider.received.bytes <= AMPLIFICATION * insider.sent


def test_a_new_address_for_each_request_brings_no_more() -> None:
    insider = Insider(answer_bytes=1 << 20)
    for number in range(100):
        insider.request(number, source=(VICTIM[0], number))
        insider.mesh.run(0.02)
    assert 0 < insider.received.bytes <= AMPLIFICATION * insider.sent


def test_who_guesses_what_it_did_not_get_is_not_talked_to_any_more() -> None:
    """Acknowledgements and replies, paced as if all had come; it is even told the next packet number."""
    insider = Insider(answer_bytes=16 << 20)
    for number in range(8):
        insider.request(number)
    for step in range(1000):
        insider.mesh.run(0.005)
        if insider.cloud.engine.peers.session(insider.robot.name) is None:
            break
        highest = insider.path_at_cloud.recovery.next_number - 1
        replies = [frame.encode_probe_reply(frame.ProbeReply(step * 8 + guess)) for guess in range(8)]
        insider.send(frame.encode_ack([(max(0, highest - 60_000), highest)], 0.0), *replies)
    assert insider.received.bytes <= AMPLIFICATION * insider.sent


def test_the_session_of_who_acknowledges_what_was_never_sent_ends() -> None:
    """From its own address, to be sent more than its path carries: the number that was left out tells."""
    mesh = Mesh(1)
    robot, cloud = mesh.robot("wlan0"), mesh.cloud("cloud-a")
    other = mesh.add("robot-2", Role.ROBOT, ["eth0"], (rule(),))
    mesh.push_views()
    cloud.answer = lambda _request: bytes(2 << 20)
    mesh.run(1.0)
    (path,) = robot.links[WLAN0]._table.paths.values()
    for number in range(3):
        robot.submit(b"%d" % number)
        mesh.run(1.0)
    assert len(robot.responses()) == 3, "an honest one is served"
    (at_cloud,) = (one for one in cloud.links[ETH0]._table.paths.values() if one.peer == robot.name)
    highest = at_cloud.recovery.next_number - 1
    assert highest > 4000
    lie = frame.encode_ack([(highest - 4000, highest)], 0.0)
    taken = path.recovery.take_numbers()
    datagram = robot.links[WLAN0]._builder._sealed(path, taken, mesh.now, lie)
    mesh.inject(robot.address(WLAN0), cloud.address(ETH0), datagram)
    mesh.run(0.1)
    assert cloud.links[ETH0].stats.dropped["acks_the_unsent"] == 1
    assert robot.name not in cloud.engine.peers
    assert "never sent" in cloud.engine.peers.refused[robot.name].why
    mesh.push_views()
    mesh.run(1.0)
    assert robot.name not in cloud.engine.peers, "whatever the control plane says"
    other.submit(b"honest")
    mesh.run(1.0)
    assert len(other.responses()) == 1
    robot.start()
    mesh.push_views()
    mesh.run(1.0)
    assert robot.name in cloud.engine.peers, "its next run begins with a clean sheet"


@pytest.mark.parametrize("away_s", [1.0, 20.0, 300.0])
def test_a_recorded_introduction_serves_once(away_s: float) -> None:
    """A stranger hears a robot that is out of the cloud's reach, and sends what it heard again from V."""
    mesh = Mesh(1)
    mesh.robot("wlan0", "wwan0")
    cloud = mesh.cloud("cloud-a")
    mesh.push_views()
    mesh.run(3.0)
    recorded: list[bytes] = []

    def tap(source: Address, _destination: Address, data: bytes) -> None:
        if source[0] == "robot.wlan0" and data[1] & frame.INTRODUCTION_FLAG:
            recorded.append(data)

    mesh.tap = tap
    for wire in mesh.all_wires_of("robot.wlan0"):
        wire.cut = True
    mesh.run(away_s + 5.0)
    received = watch(mesh)
    for _ in range(2000):
        mesh.inject(VICTIM, cloud.address(ETH0), recorded[-1])
        mesh.run(0.01)
    mesh.run(600.0)
    assert received.bytes <= len(recorded[-1])
    assert cloud.links[ETH0].stats.dropped["duplicate"] >= 1999


def test_who_hears_all_introductions_brings_little_to_a_third_party_and_only_while_they_go_on() -> None:
    """Each of them from V as soon as it is heard: answered as briefly as the robot's own would be."""
    mesh = Mesh(1)
    mesh.robot("wlan0", "wwan0")
    cloud = mesh.cloud("cloud-a")
    mesh.push_views()
    mesh.run(3.0)
    received = watch(mesh)
    seen, sent = mesh.tap, 0

    def tap(source: Address, destination: Address, data: bytes) -> None:
        nonlocal sent
        if source[0] == "robot.wlan0" and data[1] & frame.INTRODUCTION_FLAG:
            sent += len(data)
            mesh.inject(VICTIM, cloud.address(ETH0), data)
        assert seen is not None
        seen(source, destination, data)

    mesh.tap = tap
    for wire in mesh.all_wires_of("robot.wlan0"):
        wire.cut = True
    mesh.run(60.0)
    mesh.tap = seen
    assert 0 < received.bytes <= AMPLIFICATION * sent
    mesh.run(10.0)
    before = received.bytes
    mesh.run(600.0)
    assert received.bytes == before


def announce(node: Node, addresses: int) -> None:
    """A member announces V under so many addresses."""
    real = node.as_peer
    candidates = tuple(
        Candidate(InterfaceId(number // 8), InterfaceName(f"e{number // 8}"), CandidateKind.HOST, ("V", 1000 + number))
        for number in range(addresses)
    )

    def as_peer() -> Peer:
        return replace(real(), candidates=candidates)

    node.as_peer = as_peer  # type: ignore[method-assign]


@pytest.mark.parametrize("addresses", [1, 8, 256])
def test_a_member_that_announces_addresses_of_others_gets_few_bytes_there(addresses: int) -> None:
    mesh = Mesh(1)
    robot, cloud, evil = mesh.robot("wlan0", "wwan0"), mesh.cloud("cloud-a"), mesh.cloud("cloud-e")
    announce(evil, addresses)
    received = watch(mesh)
    mesh.push_views()
    mesh.run(30.0)
    assert 0 < received.bytes <= len(robot.links) * (UNPROVEN_BYTES + 30 * UNPROVEN_BYTES_PER_S)
    before = received.bytes
    for _ in range(10):
        mesh.push_views()  # again and again: no reason to start over
        mesh.run(6.0)
    assert received.bytes - before <= len(robot.links) * 61 * UNPROVEN_BYTES_PER_S
    robot.submit(b"honest")
    mesh.run(1.0)
    assert len(robot.responses()) == 1
    assert cloud.executed


def test_a_member_that_leaves_and_comes_back_gets_no_more_bytes_there() -> None:
    mesh = Mesh(1)
    robot, evil = mesh.robot("wlan0", "wwan0"), mesh.cloud("cloud-e")
    announce(evil, 256)
    evil.asleep = True  # no path to it lives: it is no peer as long as it is away
    received = watch(mesh)
    for _ in range(60):
        evil.alive = True
        mesh.push_views()
        mesh.run(0.25)
        evil.alive = False
        mesh.push_views()
        mesh.run(0.25)
    assert 0 < received.bytes <= len(robot.links) * (UNPROVEN_BYTES + 30 * UNPROVEN_BYTES_PER_S)


def test_after_a_nat_gave_a_new_port_nothing_waits_longer_than_a_round_trip() -> None:
    mesh = Mesh(1)
    robot, cloud = mesh.robot("wlan0"), mesh.cloud("cloud-a")
    mesh.push_views()
    mesh.run(3.0)
    cloud.answer = lambda _request: bytes(100_000)
    (path,) = cloud.links[ETH0]._table.paths.values()
    robot.submit(b"before")
    mesh.run(1.0)
    began = len(robot.responses())
    at = mesh.now
    path.address._proven.clear()
    path.address.move(path.remote or VICTIM, mesh.now)
    robot.submit(b"after")
    while len(robot.responses()) == began:
        mesh.run(0.001)
        assert mesh.now - at < 1.0
    assert mesh.now - at < 4 * 0.020 + 0.050, "the call, and one round trip for the proof"
    assert path.address.is_proven
    assert path.state is PathState.UP
