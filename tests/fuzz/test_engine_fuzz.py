"""A peer that is known and hostile breaks nothing, fills nothing beyond its cap, and does not stop the others."""

from __future__ import annotations

from typing import TYPE_CHECKING

from hypothesis import given, settings
from hypothesis import strategies as st

from lab.simulated.mesh import SERVICE, TYPE, Mesh, Node, rule
from lab.simulated.sessions import seal
from plr.protos.model.ids import Role, ServiceName
from plr.sidecar.core.base.values import PathState, Priority, RejectReason, RequestId
from plr.sidecar.core.cloud.answers import MAX_ANSWER_BYTES, MAX_ANSWERS
from plr.sidecar.core.cloud.answers import TIMER_SLACK as ANSWER_TIMER_SLACK
from plr.sidecar.core.cloud.executions import MAX_CACHED_BYTES, MAX_REMEMBERED_IDS, MAX_RUNNING, TIMER_SLACK
from plr.sidecar.core.cloud.refused_copies import MAX_REFUSED_COPIES
from plr.sidecar.core.message.reassembly import MAX_PEER_BYTES, MAX_PEER_MESSAGES, OVER_REMEMBERED
from plr.sidecar.core.path.owed import MAX_PENDING_FINISHED, MAX_PENDING_FRAMES
from plr.sidecar.core.transfer.room import MAX_UNDELIVERED_MESSAGES
from plr.sidecar.core.wire import frame
from plr.sidecar.core.wire.frame import BASE_SYMBOL_BYTES, MAX_MESSAGE_BYTES, Header, Probe, ProbeReply
from plr.sidecar.core.wire.messages import (
    CancelMessage,
    Message,
    RejectionMessage,
    RequestMessage,
    ResponseMessage,
    encode_message,
)

if TYPE_CHECKING:
    import random
    from collections.abc import Callable, Iterable, Iterator

    from plr.protos.model.ids import InterfaceName
    from plr.sidecar.core.cloud.cloud_role import CloudRole
    from plr.sidecar.core.path.path import Path


def fragment(number: int, total: int, symbol: int, index: int) -> bytes:
    length = max(0, min(symbol, total - index * symbol, 1150))
    return frame.encode_fragment_head(number & (2**64 - 1), total, symbol, index) + bytes(length)


def whole(number: int, message: Message) -> bytes:
    data = b"".join(encode_message(message))[:BASE_SYMBOL_BYTES]
    return frame.encode_fragment_head(number, len(data), BASE_SYMBOL_BYTES, 0) + data


def some_message(rng: random.Random) -> Message:
    request_id = RequestId(rng.choice([bytes(16), rng.randbytes(16)]))
    copy = rng.choice([0, 1, 255])
    service = rng.choice([SERVICE, SERVICE, ServiceName(f"/made/up/{rng.random()}")])
    lifetime = rng.choice([0.0, 1.0, 4e6])
    choices: list[Message] = [
        RequestMessage(
            request_id, copy, Priority.NORMAL, 0.1, lifetime, service, rng.choice([TYPE, "other"]), rng.randbytes(20)
        ),
        ResponseMessage(request_id, copy, 0.1, b"lie"),
        RejectionMessage(request_id, copy, rng.choice(list(RejectReason)), "lie"),
        CancelMessage(request_id),
    ]
    return rng.choice(choices)


# Each kind of attack writes the bodies of datagrams, given a source of numbers.
ATTACKS: dict[str, Callable[[random.Random], bytes]] = {
    "noise": lambda rng: rng.randbytes(rng.randrange(60)),
    "probes": lambda rng: frame.encode_probe(Probe(rng.getrandbits(32))) * 60,
    "unasked replies": lambda rng: frame.encode_probe_reply(ProbeReply(rng.randrange(100))),
    "forged acks": lambda rng: frame.encode_ack([(0, rng.choice([5, 50, 500, 2**63]))], 1.0),
    "huge announcements": lambda rng: fragment(rng.getrandbits(64), MAX_MESSAGE_BYTES, 1147, rng.randrange(9)),
    "never finished": lambda rng: fragment(rng.getrandbits(64), 300, 256, 0),
    "mismatching symbols": lambda rng: fragment(1, rng.randrange(400, 9000), rng.randrange(256, 400), 0),
    "others' finished": lambda rng: frame.encode_finished(frame.Finished(rng.randrange(200))),
    "messages": lambda rng: whole(rng.getrandbits(60), some_message(rng)),
    "requests": lambda rng: whole(
        rng.getrandbits(60),
        RequestMessage(RequestId(rng.randbytes(16)), 0, Priority.NORMAL, 0.1, 300.0, SERVICE, TYPE, rng.randbytes(900)),
    ),
    "goodbyes": lambda rng: frame.encode_close() * 64,
}


class Rogue:
    """A real sidecar, known to all, that also sends what it likes under its own session."""

    def __init__(self, mesh: Mesh, node: Node, victim: Node) -> None:
        self.mesh, self.node, self.victim = mesh, node, victim
        self.rng = mesh.rng

    def paths(self) -> Iterator[tuple[InterfaceName, Path, Header]]:
        """One packet number for each path from the rogue to the victim."""
        for interface, link in self.node.links.items():
            for path in link._paths.values():
                if path.peer == self.victim.name:
                    number = path.recovery.take_numbers()
                    header = Header(link.identity.interface_id, path.remote_id, self.node.session, number)
                    yield interface, path, header

    def send(self, bodies: Iterable[bytes]) -> None:
        """Each over every path, and then the victim's turn."""
        for body in bodies:
            for interface, path, header in self.paths():
                datagram = seal(path.sealing, header, body)
                target = self.victim.links[self.victim.interfaces[header.receiver_interface]]
                source = self.node.address(interface)
                target.receive_batch(memoryview(datagram), len(datagram), source, self.mesh.now)
        self.mesh.pump(self.victim)

    def answer_probes(self) -> None:
        """Stay up over there while the rogue's own sidecar is silent."""
        for link in self.victim.links.values():
            for path in link._paths.values():
                if path.peer == self.node.name:
                    self.send(
                        [
                            frame.encode_probe_reply(ProbeReply(number))
                            for number in [*path.probing._out, *path.probing._back]
                        ]
                    )

    def attack(self, kind: str, count: int) -> None:
        self.send(ATTACKS[kind](self.rng) for _ in range(count))
        taken = sum(link.stats.datagrams["received", "data"] for link in self.victim.links.values())
        condemned = self.node.name not in self.victim.engine.peers
        assert taken >= count or kind != "requests" or condemned, "the attack itself went wrong"


def assert_bounded(node: Node) -> None:
    engine = node.engine
    for reassembler in engine._inbound._reassemblers.values():
        assert reassembler.held_bytes <= MAX_PEER_BYTES
        assert len(reassembler) <= MAX_PEER_MESSAGES
        assert len(reassembler._over) <= OVER_REMEMBERED
    assert len(engine._inbound._reassemblers) <= len(engine.peers.names())
    assert len(engine._outbox) <= MAX_UNDELIVERED_MESSAGES
    assert engine._outbox.held_bytes <= MAX_PEER_BYTES * len(engine.peers.names())
    assert len(engine.stats.executions) < 20
    assert len(engine.stats.dropped) < 40
    if node.role is Role.CLOUD:
        assert_cloud_bounded(engine.cloud)
    for link in node.links.values():
        assert len(link.stats.dropped) < 20
        for path in link._paths.values():
            assert len(path.owed._frames) <= MAX_PENDING_FRAMES
            assert len(path.owed._finished) <= MAX_PENDING_FINISHED
            assert path.recovery.in_flight >= 0


def assert_cloud_bounded(cloud: CloudRole) -> None:
    answers = cloud.answers
    assert len(answers) <= MAX_ANSWERS
    assert answers.held_bytes <= MAX_ANSWER_BYTES
    assert len(answers._timers) <= 2 * len(answers) + ANSWER_TIMER_SLACK + 1
    executions = cloud.executions
    assert executions.running <= MAX_RUNNING
    assert len(executions._finished) <= MAX_REMEMBERED_IDS + MAX_RUNNING
    assert len(executions._timers) <= 2 * executions.running + TIMER_SLACK + 1
    assert executions._cache.held_bytes <= MAX_CACHED_BYTES
    assert len(executions._refused) <= MAX_REFUSED_COPIES


def arena(seed: int) -> tuple[Mesh, Node, Node, Node]:
    """A cloud, an honest robot with a fast service, and a rogue robot."""
    mesh = Mesh(seed)
    honest = mesh.robot("wlan0", rules=(rule(lifetime_s=5.0),))
    rogue = mesh.add("rogue", Role.ROBOT, ["wlan0"], (rule(),))
    cloud = mesh.cloud("cloud-a")
    mesh.push_views()
    mesh.run(0.5)
    return mesh, honest, rogue, cloud


attacks = st.lists(st.tuples(st.sampled_from(sorted(ATTACKS)), st.integers(1, 60)), max_size=12)


@settings(max_examples=40)
@given(st.integers(0, 2**32), attacks)
def test_a_hostile_robot_does_not_stop_an_honest_one(seed: int, plan: list[tuple[str, int]]) -> None:
    mesh, honest, node, cloud = arena(seed)
    rogue = Rogue(mesh, node, cloud)
    for kind, count in plan:
        rogue.attack(kind, count)
        honest.submit(b"still here")
        mesh.run(0.05)
        assert_bounded(cloud)
    mesh.run(1.0)
    assert len(honest.responses()) == len(plan)
    assert all(response.elapsed_s < 0.1 for response in honest.responses())


@settings(max_examples=40)
@given(st.integers(0, 2**32), attacks)
def test_a_hostile_cloud_does_not_stop_the_robots_other_server(seed: int, plan: list[tuple[str, int]]) -> None:
    mesh, robot, _, _ = arena(seed)
    rogue_cloud = mesh.cloud("cloud-b")
    rogue_cloud.server_delay = lambda: None
    mesh.push_views()
    mesh.run(0.5)
    rogue = Rogue(mesh, rogue_cloud, robot)
    for kind, count in plan:
        robot.submit(b"still here")
        rogue.attack(kind, count)
        mesh.run(0.05)
        assert_bounded(robot)
    mesh.run(4.0)
    answers = robot.responses()
    assert len(answers) == len({answer.request_id for answer in answers}) == len(plan)
    assert all(answer.payload == b"echo:still here" for answer in answers)


def test_a_robot_that_never_acknowledges_does_not_fill_the_outbox_for_the_others() -> None:
    mesh, honest, node, cloud = arena(1)
    rogue = Rogue(mesh, node, cloud)
    node.alive = False  # what follows is all that it says, and it hears nothing
    for _ in range(12):
        rogue.attack("requests", 1000)
        mesh.run(0.002)
    mesh.run(0.02)
    assert_bounded(cloud)
    assert len(cloud.engine._outbox) > 1000 or cloud.engine.cloud.executions.running > 1000
    honest.submit(b"still here")
    mesh.run(0.1)
    assert len(honest.responses()) == 1
    mesh.run(320.0)
    assert len(cloud.engine._outbox) == 0
    assert cloud.engine.busy == 0


def test_goodbyes_and_answers_in_turn_end_nothing_for_the_others() -> None:
    mesh, honest, node, cloud = arena(1)
    rogue = Rogue(mesh, node, cloud)
    states: set[PathState] = set()
    for _ in range(200):
        rogue.attack("goodbyes", 1)
        states.update(route.state for route in cloud.engine.routes.all_to(node.name))
        mesh.run(0.05)
        states.update(route.state for route in cloud.engine.routes.all_to(node.name))
    assert states == {PathState.DOWN, PathState.UP}, "it comes back whenever it answers a probe"
    honest.submit(b"still here")
    mesh.run(0.1)
    assert len(honest.responses()) == 1
