"""Two carriers, neither of which bears the whole load, in simulated time: with `replicate`, they share it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from lab.simulated.mesh import SERVICE, Mesh, Node, rule
from plr.protos.model.ids import InterfaceName, NodeName, Version
from plr.protos.model.mapping import Assignment, MappingSet, ServiceMapping

if TYPE_CHECKING:
    from plr.sidecar.core.base.values import ExecutionId

HZ = 5
SIZE = 120_000
LOAD = HZ * SIZE
PATHS = {"lte0": "cloud-a", "5g0": "cloud-b"}


class World:
    """Each interface has its server, and no more than that part of the load fits through it."""

    def __init__(self, *shares: float) -> None:
        self.mesh = Mesh(1)
        self.robot: Node = self.mesh.robot(*PATHS, rules=(rule(deadline_s=1.0),))
        for name in PATHS.values():
            self._answer_shortly(self.mesh.cloud(name))
        self.mesh.push_views()
        for (interface, server), share in zip(PATHS.items(), shares, strict=True):
            for wire in self.mesh.both_ways(f"robot.{interface}", f"{server}.eth0"):
                wire.delay_s, wire.bytes_per_s = 0.03, share * LOAD
        self.mesh.run(1.0)
        pairs = tuple(Assignment(InterfaceName(interface), NodeName(server)) for interface, server in PATHS.items())
        assert self.mesh.push_mapping(self.robot, MappingSet(Version(7), 1, (ServiceMapping(SERVICE, pairs),))) is None

    @staticmethod
    def _answer_shortly(cloud: Node) -> None:
        complete = cloud.engine.cloud.complete

        def answer(execution: ExecutionId, payload: bytes, server_s: float, now: float) -> None:
            complete(execution, payload[:9], server_s, now)

        cloud.engine.cloud.complete = answer  # type: ignore[method-assign,assignment]  # an echo would fill both ways

    def elapsed(self, seconds: float) -> list[float]:
        """Send requests for so long; returns how long each took, infinity without an answer."""
        asked = []
        for _ in range(int(seconds * HZ)):
            self.mesh.calls += 1
            asked.append(self.robot.submit(self.mesh.calls.to_bytes(4, "big") + bytes(SIZE)))
            self.mesh.run(1 / HZ)
        self.mesh.run(5.0)
        answers = {event.request_id: event.elapsed_s for event in self.robot.responses()}
        return [answers.get(request_id, float("inf")) for request_id in asked]

    def carried(self) -> dict[str, float]:
        """Bytes of requests that left over each interface, over what was asked."""
        sent = {name: sum(path.bytes_sent for path in link._paths.values()) for name, link in self.robot.links.items()}
        return {str(name): all_bytes / (self.mesh.calls * SIZE) for name, all_bytes in sent.items()}


@pytest.mark.parametrize("shares", [(0.6, 0.6), (0.7, 0.5)])
def test_carriers_that_bear_the_load_together_do(shares: tuple[float, float]) -> None:
    elapsed = World(*shares).elapsed(15.0)
    assert sum(each > 1.0 for each in elapsed) <= 0.05 * len(elapsed)


def test_carriers_that_each_bear_the_load_both_send_everything() -> None:
    world = World(4.0, 3.0)
    elapsed = world.elapsed(6.0)
    assert max(elapsed) < 0.5
    assert min(world.carried().values()) > 0.7


def test_what_a_carrier_that_goes_dark_was_to_do_the_other_does_in_time() -> None:
    world = World(2.0, 1.2)
    world.elapsed(3.0)
    for wire in world.mesh.all_wires_of("robot.lte0"):
        wire.cut = True
    elapsed = world.elapsed(5.0)
    assert max(elapsed) < 1.0
