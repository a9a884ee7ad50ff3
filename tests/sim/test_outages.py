"""How soon a path is used again after an outage, whatever happened before it."""

from __future__ import annotations

import pytest

from lab.simulated.mesh import Mesh, rule
from plr.protos.model.ids import NodeName
from plr.sidecar.core.base.values import PathState
from plr.sidecar.core.path.probing import FIRST_PROBE_S
from tests.sim.test_mesh import mapped

SIZE = 120_000
EVERY_S = 0.2
GOOD, SLOW = 2_000_000.0, 60_000.0
QUEUE = 1_200_000.0
SLOW_S = 4.0
OUTAGE_S = 10.0


@pytest.mark.parametrize("outage_s", [0.5, 1.5, 4.0, 10.0])
@pytest.mark.parametrize("seed", range(2))
def test_an_outage_after_a_slow_spell_is_over_when_the_network_is_back(outage_s: float, seed: int) -> None:
    """The slow spell fills the network's queue, which makes round trips of seconds; the outage then empties it."""
    mesh = Mesh(seed)
    robot = mesh.robot("wlan0", rules=(rule(lifetime_s=60.0),))
    mesh.cloud("cloud-a")
    up, down = mesh.both_ways("robot.wlan0", "cloud-a.eth0")

    def carry(bytes_per_s: float) -> None:
        up.bytes_per_s, up.buffer_bytes, up.busy_until = bytes_per_s, QUEUE, mesh.now

    def ask(seconds: float) -> list[float]:
        """The latencies of requests that come in this time."""
        asked = []
        for _ in range(round(seconds / EVERY_S)):
            asked.append(robot.submit(bytes(SIZE)))
            mesh.run(EVERY_S)
        taken = {answer.request_id: answer.elapsed_s for answer in robot.responses()}
        return [taken.get(request, 60.0) for request in asked]

    carry(GOOD)
    mesh.push_views()
    mesh.run(1.0)
    mapped(mesh, robot, ("wlan0", "cloud-a"))
    ask(5.0)
    up.bytes_per_s = SLOW
    ask(SLOW_S)
    up.cut = down.cut = True
    mesh._due.clear()  # what is under way is lost
    ask(outage_s)
    up.cut = down.cut = False
    carry(GOOD)
    ask(1.5)
    # Where the slow spell was noticed, which is chance, what waits since then leaves first at the rate that it had.
    assert max(ask(3.0)) < 0.75


@pytest.mark.audit("dp-17")
@pytest.mark.parametrize("seed", range(12))
def test_with_one_path_back_the_others_to_its_peer_are_sought_at_once(seed: int) -> None:
    """What was asked in the dark and is still in time would otherwise leave over the first one alone, for as long as
    the others' probes are apart after a long outage."""
    mesh = Mesh(seed)
    robot = mesh.robot("wlan0", "wwan0")
    mesh.cloud("cloud-a")
    mesh.push_views()
    mesh.run(1.0)
    paths = [("wlan0", "cloud-a"), ("wwan0", "cloud-a")]
    mapped(mesh, robot, *paths)
    wires = [wire for interface, _ in paths for wire in mesh.both_ways(f"robot.{interface}", "cloud-a.eth0")]

    def ask(seconds: float) -> None:
        for _ in range(round(seconds / EVERY_S)):
            robot.submit(bytes(1000))
            mesh.run(EVERY_S)

    ask(1.0)
    for wire in wires:
        wire.cut = True
    ask(OUTAGE_S + seed * EVERY_S / 12)
    mesh.run(seed * EVERY_S / 12)
    for wire in wires:
        wire.cut = False
    back: list[float] = []
    for _ in range(1000):
        up = sum(route.state is PathState.UP for route in robot.engine.routes.all_to(NodeName("cloud-a")))
        back += [mesh.now] * (up - len(back))
        if len(back) == len(paths):
            break
        mesh.run(0.001)
    assert back[1] - back[0] < FIRST_PROBE_S + 0.03  # a probe at once, but no sooner than that after the last; its way


@pytest.mark.audit("dp-16")
@pytest.mark.parametrize("trouble", ["blackout", "shorter packets"])
def test_what_was_lost_in_a_silence_does_not_end_the_start_after_it(trouble: str) -> None:
    """A handover of 0.2 s, or a route that takes shorter packets from now on, in the middle of 4 MB at 60 Mbit/s.

    The sender begins again with the least, and doubles. What it had under way before is found lost only then.
    """
    mesh = Mesh(1)
    robot = mesh.robot("wlan0", rules=(rule(lifetime_s=60.0, deadline_s=20.0),))
    cloud = mesh.cloud("cloud-a")
    cloud.answer = lambda payload: payload[:4]
    wires = mesh.both_ways("robot.wlan0", "cloud-a.eth0")
    for wire in wires:
        wire.bytes_per_s, wire.buffer_bytes, wire.mtu = 7.5e6, QUEUE, 1500
    mesh.push_views()
    mesh.run(3.0)
    mapped(mesh, robot, ("wlan0", "cloud-a"))
    for _ in range(10):
        robot.submit(bytes(100_000))
        mesh.run(0.2)

    def change(**to: object) -> None:
        for wire in wires:
            for name, value in to.items():
                setattr(wire, name, value)

    if trouble == "blackout":
        mesh.at(0.25, lambda: change(cut=True))
        mesh.at(0.45, lambda: change(cut=False))
    else:
        mesh.at(0.25, lambda: change(mtu=1300))
    robot.submit(bytes(4_000_000))
    mesh.run(4.0)
    # 0.55 s of sending, 0.2 s of silence; half a second to begin again; it took 1.8 s when start-up ended early.
    assert robot.responses()[-1].elapsed_s < 1.5
