"""What sidecars say to what they are sent: acks, nacks and notices of who went."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from plr.controlplane.core.publish.publisher import RESEND_S
from plr.protos.model.mapping import MappingSet
from plr.protos.model.members import PeerSet, RemovalReason
from plr.protos.model.status import SyncState
from plr.protos.model.stream import Ack, ResourceKind
from tests.support.control_world import SETTLED_S

if TYPE_CHECKING:
    from tests.support.control_world import World


def test_a_nack_is_shown_and_the_same_content_is_not_sent_again_at_once(world: World) -> None:
    world.cloud("a")
    robot = world.robot()
    robot.refuse = lambda message: isinstance(message, PeerSet)
    world.run(SETTLED_S)
    sent = len(robot.peer_sets)
    world.run(RESEND_S - SETTLED_S - 0.1)
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


@pytest.mark.parametrize("kind", [PeerSet, MappingSet])
def test_what_was_refused_is_sent_again_until_it_is_taken(world: World, kind: type[PeerSet | MappingSet]) -> None:
    """Why it was refused passes, and nothing else changes meanwhile."""
    world.cloud("a")
    robot = world.robot()
    robot.refuse = lambda message: isinstance(message, kind)
    world.run(SETTLED_S + 4 * RESEND_S)
    refused = [message for message in robot.received if isinstance(message, kind)]
    assert 4 <= len(refused) <= 6
    assert sorted({message.version for message in refused}) == [message.version for message in refused]
    robot.refuse = lambda message: False
    world.run(RESEND_S + 0.1)
    taken = [message for message in robot.received if isinstance(message, kind)]
    assert len(taken) == len(refused) + 1
    (status,) = (found for found in world.core.status(world.now) if found.peer.name == "robot")
    assert (status.peers.state, status.mapping.state) == (SyncState.SYNCED, SyncState.SYNCED)
    assert robot.peer_names == {"a"}
    assert set(robot.pairs().values()) == {"a"}
    # Nobody refuses anything: nothing is sent any more, and no timer asks for it.
    world.run(3 * RESEND_S)
    assert len([message for message in robot.received if isinstance(message, kind)]) == len(taken)


def test_the_same_refusal_is_told_once_until_something_is_taken(world: World) -> None:
    world.cloud("a")
    robot = world.robot()
    robot.refuse = lambda message: isinstance(message, PeerSet)
    world.run(SETTLED_S + 3 * RESEND_S)
    assert len(world.nacks) == 1
    assert world.core.counters.nacks[ResourceKind.PEERS] >= 4
    robot.refuse = lambda message: False
    world.run(SETTLED_S + RESEND_S)
    robot.refuse = lambda message: isinstance(message, PeerSet)
    world.cloud("b")
    world.run(SETTLED_S)
    assert len(world.nacks) == 2


def test_what_a_sidecar_refused_before_its_stream_was_lost_is_sent_once_on_the_next(world: World) -> None:
    world.cloud("a")
    robot = world.robot()
    robot.refuse = lambda message: True
    world.run(SETTLED_S)
    world.drop_stream(robot)
    world.run(0.1)
    robot.refuse = lambda message: False
    before = len(robot.peer_sets)
    world.join(robot.registration)
    world.run(2 * RESEND_S)
    assert len(robot.peer_sets) == before + 1
    assert robot.peer_names == {"a"}


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
