"""Datagrams by the ten thousand into the cores of a running mesh: nothing raises, grows, or reaches an application.

Random, made of real ones (cut, stretched, bits flipped, replayed, headed by a live session), alone and in runs as the
kernel joins them. `--fuzz-datagrams 1000000` (make fuzz) is the long version.
"""

from __future__ import annotations

import gc
import random
from typing import TYPE_CHECKING

import psutil
import pytest

from lab.attacker.junk import flipped, headed, mangled, noise
from lab.simulated.mesh import Mesh, Node
from plr.protos.model.ids import InterfaceName
from plr.sidecar.core.wire.frame import HEADER_BYTES
from tests.fuzz.test_engine_fuzz import ATTACKS, Rogue, arena, assert_bounded

if TYPE_CHECKING:
    from plr.protos.model.ids import Address

MB = 1e6
SEEN = 400
"""Real datagrams that others are made of, the newest ones."""
ROUND = 200
"""Datagrams between two honest requests."""
LONG_ROUND_S = 0.5
GROWTH_BYTES = 24 * MB
"""Resident memory that may come on top, whatever the number of datagrams: allocators round up."""


class Eavesdropper:
    """Keeps what passes a mesh, and makes junk of it."""

    def __init__(self, mesh: Mesh, seed: int) -> None:
        self.rng = random.Random(seed)
        self.seen: list[tuple[Address, Address, bytes]] = []
        carry = mesh._carry

        def listen(source: Address, destination: Address, data: bytes) -> None:
            self.seen.append((source, destination, data))
            del self.seen[: -2 * SEEN]
            carry(source, destination, data)

        mesh._carry = listen  # type: ignore[method-assign]  # on the way, which is what an attacker is

    def junk(self, node: Node) -> tuple[InterfaceName, bytes, int, Address]:
        """An interface of the node, a run of datagrams for it, the size of each, and where they seem to come from."""
        rng = self.rng
        source, destination, real = rng.choice(self.seen[-SEEN:])
        name, interface = destination[0].rsplit(".", 1)
        if name != node.name:
            interface = rng.choice(node.interfaces)
        if rng.random() < 0.2:
            source = (f"10.0.0.{rng.randrange(256)}", rng.randrange(1, 65536))
        data = self._make(real)
        segment = len(data)
        if rng.random() < 0.3:
            run = [self._make(real)[:segment].ljust(segment, b"\0") for _ in range(rng.randint(1, 20))]
            data = b"".join([data, *run])[: 60_000 // segment * segment]
            if rng.random() < 0.5:
                data = data[: -rng.randrange(segment)] if segment > 1 else data
        return InterfaceName(interface), data, segment, source

    def _make(self, real: bytes) -> bytes:
        rng = self.rng
        match rng.randrange(6):
            case 0:
                return noise(rng)
            case 1:
                return headed(real, rng)
            case 2:
                return flipped(real, rng)
            case 3:
                return mangled(real, rng) or b"\0"
            case 4:
                return real[: rng.randint(1, len(real))]
            case _:
                return real


def resident() -> int:
    """Bytes of this process."""
    gc.collect()
    return int(psutil.Process().memory_info().rss)


@pytest.mark.timeout(3600)
def test_fuzzed_datagrams_change_nothing(fuzz_datagrams: int) -> None:
    mesh = Mesh(1)
    robot, cloud = mesh.robot("wlan0", "wwan0"), mesh.cloud("cloud-a")
    spy = Eavesdropper(mesh, 1)
    mesh.push_views()
    mesh.run(0.5)
    asked = fed = 0
    grown: list[int] = []
    while fed < fuzz_datagrams:
        robot.submit(b"honest %d" % asked)
        asked += 1
        until = fed + ROUND
        while fed < until:
            node = spy.rng.choice((robot, cloud))
            interface, data, segment, source = spy.junk(node)
            node.links[interface].receive_batch(memoryview(data), segment, source, mesh.now)
            fed += -(-len(data) // segment)
            mesh.pump(node)
        mesh.run(0.05)
        robot.events, done = [], len(robot.responses())
        assert done == 1, f"after {fed} datagrams a request has {done} answers"
        assert len(cloud.executed) == asked, "each request runs once, and nothing else does"
        cloud.events.clear()
        if asked % 20 == 0:
            grown.append(resident())
    assert all(isinstance(payload, bytes) and payload.startswith(b"honest") for payload in cloud.executed)
    assert refusals(robot) + refusals(cloud) > fed * 0.9
    assert max(grown[1:], default=0) - grown[0] < GROWTH_BYTES


def refusals(node: Node) -> int:
    return sum(sum(link.stats.dropped.values()) for link in node.links.values())


def frames_of(rng: random.Random) -> bytes:
    """What a member of the fleet might seal: frames of several kinds, and most often something wrong with them."""
    body = b"".join(ATTACKS[kind](rng) for kind in rng.choices(sorted(ATTACKS), k=rng.randint(1, 3)))
    return (mangled(body, rng) if rng.random() < 0.8 else body)[:1150]


@pytest.mark.timeout(3600)
def test_a_member_that_seals_anything(fuzz_datagrams: int) -> None:
    """With the right keys: it may do what a member may, but breaks nothing and stops nobody else."""
    mesh, honest, node, cloud = arena(1)
    rogue = Rogue(mesh, node, cloud)
    asked = 0
    grown: list[int] = []
    for number in range(fuzz_datagrams // ROUND):
        rogue.send(frames_of(mesh.rng) for _ in range(ROUND))
        honest.submit(b"honest %d" % asked)
        asked += 1
        mesh.run(LONG_ROUND_S)
        assert_bounded(cloud)
        for one in (honest, node, cloud):
            one.executed.clear()
        cloud.events.clear()
        node.events.clear()
        if number % 20 == 0:
            grown.append(resident())
    mesh.run(1.0)
    assert len(honest.responses()) == asked
    assert refusals(cloud) > fuzz_datagrams * 0.2
    # What the cloud remembers of requests goes with their lifetime, 300 s: the long version lasts far longer.
    assert grown[-1] - grown[len(grown) // 2] < GROWTH_BYTES


def test_headers_stay_where_the_attacker_thinks_they_are() -> None:
    """The junk above keeps the session of a real datagram: if the layout changes, the attack has to follow."""
    mesh = Mesh(2)
    mesh.robot("wlan0")
    mesh.cloud("cloud-a")
    spy = Eavesdropper(mesh, 2)
    mesh.push_views()
    mesh.run(0.2)
    sessions = {node.session.to_bytes(8, "big") for node in mesh.nodes.values()}
    assert {data[HEADER_BYTES - 16 : HEADER_BYTES - 8] for _, _, data in spy.seen} == sessions
