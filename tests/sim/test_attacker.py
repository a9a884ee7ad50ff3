"""An attacker on the wire, who sees every datagram and sends what it likes: nothing changes, and everything counts."""

from __future__ import annotations

import random
from typing import TYPE_CHECKING, NamedTuple

import pytest

from plr.sidecar.core.wire import frame
from tests.sim.test_mesh import assert_at_most_once, assert_each_answered_once
from tests.sim.test_sealing import dropped, pair

if TYPE_CHECKING:
    from collections.abc import Callable

    from lab.simulated.mesh import Mesh, Node
    from plr.protos.model.ids import Address

ELSEWHERE: Address = ("attacker.eth0", 666)


class Seen(NamedTuple):
    """A datagram on the wire."""

    source: Address
    destination: Address
    data: bytes

    def with_data(self, data: bytes) -> Seen:
        return self._replace(data=data)

    def replaced(self, start: int, new: bytes) -> Seen:
        return self.with_data(self.data[:start] + new + self.data[start + len(new) :])


def flipped(rng: random.Random, seen: Seen) -> Seen:
    place = rng.randrange(len(seen.data))
    return seen.replaced(place, bytes([seen.data[place] ^ 1 << rng.randrange(8)]))


def renumbered(seen: Seen) -> Seen:
    return seen.replaced(12, (int.from_bytes(seen.data[12:20], "big") + 10**6).to_bytes(8, "big"))


ATTACKS: dict[str, Callable[[random.Random, Seen], Seen]] = {
    "replayed": lambda rng, seen: seen,
    "replayed from elsewhere": lambda rng, seen: seen._replace(source=ELSEWHERE),
    "bit-flipped": flipped,
    "reflected": lambda rng, seen: seen._replace(source=seen.destination, destination=seen.source),
    "truncated": lambda rng, seen: seen.with_data(seen.data[: rng.randrange(1, len(seen.data))]),
    "lengthened": lambda rng, seen: seen.with_data(seen.data + bytes(16)),
    "of another session": lambda rng, seen: seen.replaced(4, rng.randbytes(8)),
    "of another path": lambda rng, seen: seen.replaced(2, bytes([1 - seen.data[2], seen.data[3]])),
    "in clear": lambda rng, seen: seen.replaced(1, b"\0"),
    "of another phase": lambda rng, seen: seen.replaced(1, bytes([seen.data[1] ^ frame.PHASE_FLAG])),
    "an introduction": lambda rng, seen: seen.replaced(1, bytes([seen.data[1] ^ frame.INTRODUCTION_FLAG])),
    "renumbered": lambda rng, seen: renumbered(seen),
    "made up": lambda rng, seen: seen.with_data(rng.randbytes(len(seen.data))),
}


def state(mesh: Mesh) -> list[tuple[object, ...]]:
    """What an attacker would want to change."""
    return [
        (path.id, path.session, path.state, path.remote, path.opening.phase, path.received.largest)
        for node in mesh.nodes.values()
        for link in node.links.values()
        for path in link._paths.values()
    ]


def record(mesh: Mesh, robot: Node, calls: int) -> list[Seen]:
    """Call, and return everything that was on the wire meanwhile."""
    wire: list[Seen] = []
    mesh.tap = lambda source, destination, data: wire.append(Seen(source, destination, data))
    for number in range(calls):
        robot.submit(number.to_bytes(4, "big") + bytes(5000))
        mesh.run(0.05)
    mesh.run(0.2)
    mesh.tap = None
    return wire


@pytest.mark.parametrize("kind", ATTACKS)
def test_an_attack_changes_nothing_is_answered_with_nothing_and_is_counted(kind: str) -> None:
    mesh, robot, cloud = pair()
    wire = record(mesh, robot, 20)
    assert len(wire) > 200
    rng = random.Random(7)
    before = state(mesh)
    counted = sum(dropped(node).total() for node in (robot, cloud))
    sent: list[bytes] = []
    mesh.tap = lambda source, destination, data: sent.append(data)
    for seen in wire:
        mesh.inject(*ATTACKS[kind](rng, seen))
    assert sent == [], "not a byte in answer"
    assert state(mesh) == before
    assert sum(dropped(node).total() for node in (robot, cloud)) - counted == len(wire)


@pytest.mark.parametrize("kind", ATTACKS)
def test_the_traffic_beside_an_attack_loses_nothing(kind: str) -> None:
    mesh, robot, cloud = pair()
    rng = random.Random(7)
    attacks: list[Seen] = []

    def attack(source: Address, destination: Address, data: bytes) -> None:
        # Before the datagram itself arrives, and again when it is old.
        attacks.append(ATTACKS[kind](rng, Seen(source, destination, data)))
        for seen in (attacks[-1], attacks[rng.randrange(len(attacks))]):
            if kind.startswith("replayed") and seen is attacks[-1]:
                continue  # that would be the network's own doing
            # What is replayed comes after what it repeats: sooner would be the network's own doing, too.
            delay = 0.02 if kind.startswith("replayed") else 0.001
            mesh.at(delay, lambda seen=seen: mesh.inject(*seen))  # type: ignore[misc]  # bound now

    mesh.tap = attack
    for number in range(40):
        robot.submit(number.to_bytes(4, "big") + bytes(20_000))
        mesh.run(0.05)
    mesh.run(1.0)
    assert_each_answered_once(robot, 40)
    assert_at_most_once(cloud)
    assert all(response.elapsed_s < 0.1 for response in robot.responses())
    assert dropped(robot).total() > 100
    assert dropped(cloud).total() > 100


def test_an_old_session_replayed_into_a_new_one_is_of_nobody() -> None:
    mesh, robot, cloud = pair()
    wire = record(mesh, robot, 5)
    for node in (robot, cloud):
        node.start()
    mesh.push_views()
    mesh.run(1.0)
    before = state(mesh)
    for seen in wire:
        mesh.inject(*seen)
    assert state(mesh) == before
    assert dropped(robot)["unknown_session"] + dropped(cloud)["unknown_session"] >= len(wire)


def test_nothing_of_what_is_carried_stands_on_the_wire() -> None:
    mesh, robot, _ = pair()
    wire: list[bytes] = []
    mesh.tap = lambda source, destination, data: wire.append(data)
    request_id = robot.submit(b"a payload to be looked for" * 100)
    mesh.run(1.0)
    assert_each_answered_once(robot, 1)
    everything = b"".join(wire)
    for secret in (b"a payload", b"/echo", b"plr_test", request_id[8:], robot.token, b"cloud-a", b"robot"):
        assert secret not in everything
