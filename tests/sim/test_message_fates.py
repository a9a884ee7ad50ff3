"""What becomes of half messages: called off by their sender, or forgotten by their receiver."""

from __future__ import annotations

from lab.simulated.mesh import Mesh, Node, rule
from plr.sidecar.core.message.reassembly import MAX_SILENCE_S
from plr.sidecar.core.path.pmtu import HEADERS_V4
from plr.sidecar.core.wire.frame import BASE_BYTES
from tests.sim.test_mesh import mapped, two_by_two

SIZE = 2_000_000
BYTES_PER_S = 1_000_000.0


def unfinished(node: Node) -> int:
    return sum(len(reassembler) for reassembler in node.engine._inbound._reassemblers.values())


def test_a_message_that_the_receiver_forgot_in_an_outage_is_sent_again() -> None:
    mesh = Mesh(1)
    robot = mesh.robot("wlan0", rules=(rule(lifetime_s=120.0),))
    cloud = mesh.cloud("cloud-a")
    wires = mesh.both_ways("robot.wlan0", "cloud-a.eth0")
    wires[0].bytes_per_s = BYTES_PER_S
    for wire in wires:
        wire.mtu = BASE_BYTES + HEADERS_V4  # else it would be cut again for its size
    mesh.push_views()
    mesh.run(1.0)
    robot.submit(bytes(SIZE))
    mesh.run(1.0)
    assert unfinished(cloud) == 1
    for wire in wires:
        wire.cut = True
    mesh.run(MAX_SILENCE_S + 5.0)
    assert cloud.engine.stats.dropped["reassembly_expired"] == 1
    for wire in wires:
        wire.cut = False
    mesh.run(30.0)
    assert [len(response.payload) for response in robot.responses()] == [SIZE + 5]
    assert robot.engine.stats.dropped["message_forgotten"] == 1
    assert len(robot.engine._outbox) == unfinished(cloud) == 0


def test_a_copy_that_is_called_off_leaves_no_half_message_behind() -> None:
    mesh, robot, _, slow = two_by_two()
    mapped(mesh, robot, ("wlan0", "cloud-a"), ("wwan0", "cloud-b"))
    for wire in mesh.all_wires_of("robot.wwan0"):
        wire.bytes_per_s = BYTES_PER_S / 5
    calls = 6
    for number in range(calls):
        robot.submit(bytes([number]) + bytes(SIZE // 20))
        mesh.run(2.0)
    assert len(robot.responses()) == calls
    assert slow.engine.stats.dropped["reassembly_abandoned"] >= calls // 2
    assert unfinished(slow) == 0
