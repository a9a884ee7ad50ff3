"""What sidecars say to what they are sent: acks, nacks and notices of who went."""

from __future__ import annotations

from typing import TYPE_CHECKING

from protos.model import Ack, PeerSet, RemovalReason, ResourceKind
from protos.status import SyncState
from tests.sim.control_world import SETTLED_S

if TYPE_CHECKING:
    from tests.sim.control_world import World


def test_a_nack_is_shown_and_the_same_content_is_not_sent_again(world: World) -> None:
    world.cloud("a")
    robot = world.robot()
    robot.refuse = lambda message: isinstance(message, PeerSet)
    world.run(SETTLED_S)
    sent = len(robot.peer_sets)
    world.run(3 * SETTLED_S)
    assert len(robot.peer_sets) == sent
    (status,) = (found for found in world.core.status(world.now) if found.peer.name == "robot")
    assert status.peers.state is SyncState.REJECTED
    assert status.peers.error == "not with me"
    assert status.peers.version_acked == 0
    assert world.nacks[0].sidecar == "robot"
    robot.refuse = lambda message: False
    world.cloud("b")
    world.run(SETTLED_S)
    (status,) = (found for found in world.core.status(world.now) if found.peer.name == "robot")
    assert status.peers.state is SyncState.SYNCED


def test_stale_answers_are_counted_and_ignored(world: World) -> None:
    world.cloud("a")
    robot = world.robot()
    robot.silent = True
    world.run(0.2)
    first = robot.peer_sets[-1]
    world.cloud("b")
    world.run(0.2)
    assert robot.peer_sets[-1].nonce > first.nonce
    world.say(robot, Ack(ResourceKind.PEERS, first.version, first.nonce))
    (status,) = (found for found in world.core.status(world.now) if found.peer.name == "robot")
    assert status.peers.state is SyncState.STALE
    assert world.core.counters.stale_answers == 1


def test_notices_cover_all_that_a_slow_sidecar_may_know(world: World) -> None:
    a, b, robot = world.cloud("a"), world.cloud("b"), world.robot()
    robot.silent = True
    world.run(0.2, heartbeats=False)
    assert robot.peer_names == {"a", "b"}
    world.leave(a)
    world.run(0.2, heartbeats=False)
    assert robot.removed == {"a": RemovalReason.LEFT}
    # Nothing was acknowledged yet: the next set may be the first one that it applies.
    world.leave(b)
    world.run(0.2, heartbeats=False)
    assert robot.removed == {"a": RemovalReason.LEFT, "b": RemovalReason.LEFT}
    last = robot.peer_sets[-1]
    world.say(robot, Ack(ResourceKind.PEERS, last.version, last.nonce))
    world.cloud("c")
    world.run(0.2, heartbeats=False)
    assert robot.peer_names == {"c"}
    assert robot.removed == {}
