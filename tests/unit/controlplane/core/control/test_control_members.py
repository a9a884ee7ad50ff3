"""Who is there: streams that come, go and are replaced, leases, and names."""

from __future__ import annotations

import dataclasses

import pytest

from plr.controlplane.core.control import control
from plr.controlplane.core.publish.messages import CloseReason
from plr.controlplane.core.registry.registry import Refusal
from plr.protos.base.errors import DecodeError
from plr.protos.model.ids import NodeName, Role
from plr.protos.model.members import CandidateSet, RemovalReason, ServiceSet
from plr.protos.model.status import SyncState
from plr.protos.model.stream import Drain
from tests.support.control_world import SETTLED_S, World
from tests.support.samples import interfaces, offer, registration


def test_a_silent_cloud_disappears_with_its_lease(world: World) -> None:
    a, b = world.cloud("a"), world.cloud("b")
    robot = world.robot()
    world.run(SETTLED_S)
    a.silent = True
    world.run(world.settings.lease_s + SETTLED_S)
    assert a.closed == [CloseReason.LEASE_EXPIRED]
    assert world.departed == ["a"]
    assert robot.peer_names == {"b"}
    assert robot.removed == {"a": RemovalReason.LEASE_EXPIRED}
    assert set(robot.pairs().values()) == {"b"}
    assert b.peer_names == {"robot"}


def test_a_cloud_that_says_goodbye_is_given_no_new_requests_and_then_has_left(world: World) -> None:
    a = world.cloud("a")
    world.cloud("b")
    robot = world.robot()
    world.run(SETTLED_S)
    world.leave(a)
    world.run(0.2)
    assert robot.peer_names == {"b"}
    assert robot.removed == {"a": RemovalReason.LEFT}
    assert set(robot.pairs().values()) == {"b"}


def test_a_lost_stream_alone_changes_nothing_for_the_peers(world: World) -> None:
    a = world.cloud("a")
    robot = world.robot()
    world.run(SETTLED_S)
    sets = len(robot.peer_sets)
    world.drop_stream(a)
    world.run(world.settings.lease_s / 2)
    world.join(dataclasses.replace(a.registration, peers_version=a.peers_version))
    world.run(SETTLED_S)
    assert len(robot.peer_sets) == sets
    # It holds the set sent last: nothing is sent again.
    assert len(a.peer_sets) == 1
    assert world.core.status(world.now)[0].peers.state is SyncState.SYNCED


def test_a_newer_incarnation_ends_the_older_stream(world: World) -> None:
    a = world.cloud("a")
    old_stream = a.stream
    robot = world.robot()
    world.run(SETTLED_S)
    world.join(registration("a", Role.CLOUD, incarnation=2))
    assert world.closings == [(old_stream, CloseReason.REPLACED)]
    world.run(0.2)
    assert [peer.incarnation for peer in robot.peers] == [2]
    assert robot.removed == {}


def test_messages_on_a_replaced_stream_are_ignored(world: World) -> None:
    a = world.cloud("a")
    old_stream = a.stream
    world.join(registration("a", Role.CLOUD, incarnation=2))
    assert old_stream is not None
    world.core.receive(old_stream, CandidateSet(), world.now)
    assert world.core.counters.old_stream_messages == 1
    world.core.disconnected(old_stream, world.now)
    assert world.core.registry.get(a.name) is not None


def test_an_older_incarnation_is_refused(world: World) -> None:
    world.join(registration("a", Role.CLOUD, incarnation=2))
    result = world.core.register(registration("a", Role.CLOUD, incarnation=1), world.now)
    assert result is Refusal.OLDER_INCARNATION


def test_a_second_registration_on_a_stream_is_an_error(world: World) -> None:
    robot = world.robot()
    with pytest.raises(DecodeError, match="second registration"):
        world.say(robot, registration("robot"))


def test_a_sidecar_is_shown_only_when_it_told_where_it_is(world: World) -> None:
    robot = world.robot()
    cloud = world.join(registration("a", Role.CLOUD))
    world.run(0.2)
    assert robot.peer_names == set()
    world.say(cloud, CandidateSet(interfaces("eth0")))
    world.say(cloud, ServiceSet((offer(),)))
    world.run(0.2)
    assert robot.peer_names == {"a"}
    assert len(robot.peer_sets[-1].peers[0].candidates) == 1


# ── restart of the control plane ──


def test_an_expired_robot_that_returns_is_told_who_went_meanwhile() -> None:
    world = World()
    a, b = world.cloud("a"), world.cloud("b")
    robot = world.robot()
    world.run(SETTLED_S)
    world.drop_stream(robot)
    world.run(world.settings.lease_s + 1.0)
    assert a.peer_names == set()
    world.leave(b)
    world.join(dataclasses.replace(robot.registration, peers_version=robot.peers_version))
    world.run(0.2)
    assert robot.peer_names == {"a"}
    assert robot.removed == {"b": RemovalReason.LEFT}


@pytest.mark.parametrize(
    ("reason", "closed"),
    [(RemovalReason.REVOKED, CloseReason.REVOKED), (RemovalReason.EXPIRED, CloseReason.CERTIFICATE_ENDED)],
)
def test_a_server_that_must_not_be_talked_to_goes_at_once_and_its_peers_are_told_why(
    world: World, reason: RemovalReason, closed: CloseReason
) -> None:
    a, b = world.cloud("a"), world.cloud("b")
    robot = world.robot()
    world.run(SETTLED_S)
    world.all_up(robot, ("a", "b"))
    world.run(SETTLED_S)
    assert set(robot.pairs().values()) == {"a", "b"}
    world.core.part_with(NodeName("b"), reason, world.now)
    world.step()
    assert b.closed == [closed]
    assert robot.peer_names == {"a"}
    assert robot.removed == {"b": reason}
    assert "b" not in robot.pairs().values()
    assert a.closed == []
    world.run(SETTLED_S)
    assert set(robot.pairs().values()) == {"a"}
    assert world.core.registry.counters.departed[reason] == 1
    # Nobody there: nothing to do.
    world.core.part_with(NodeName("b"), reason, world.now)
    assert world.core.registry.counters.departed[reason] == 1


def test_a_stream_that_is_ended_leaves_its_sidecar_registered(world: World) -> None:
    a, robot = world.cloud("a"), world.robot()
    world.run(SETTLED_S)
    world.core.end_stream(NodeName("a"), CloseReason.CERTIFICATE_ENDED, world.now)
    world.run(0.5)
    assert a.closed == [CloseReason.CERTIFICATE_ENDED]
    assert robot.peer_names == {"a"}


def test_a_robot_whose_stream_is_ended_is_sent_nothing_more(world: World) -> None:
    world.cloud("a")
    b, robot = world.cloud("b"), world.robot()
    world.run(SETTLED_S)
    received = len(robot.received)
    world.core.end_stream(robot.name, CloseReason.CERTIFICATE_ENDED, world.now)
    world.dispatch()
    world.leave(b)  # Its mapping changes within its lease.
    world.run(SETTLED_S)
    assert robot.closed == [CloseReason.CERTIFICATE_ENDED]
    assert len(robot.received) == received
    known = world.core.registry.get(robot.name)
    assert known is not None
    assert known.stream is None
    world.join(dataclasses.replace(robot.registration, peers_version=robot.peers_version))
    world.run(SETTLED_S)
    assert robot.peer_names == {"a"}
    assert set(robot.pairs().values()) == {"a"}


def test_who_was_about_to_go_has_left_when_its_stream_is_ended(world: World) -> None:
    a, robot = world.cloud("a"), world.robot()
    world.run(SETTLED_S)
    world.say(a, Drain())
    world.core.end_stream(a.name, CloseReason.CERTIFICATE_ENDED, world.now)
    world.run(0.5)
    assert world.departed == ["a"]
    assert robot.removed == {"a": RemovalReason.LEFT}


def test_the_revocation_list_goes_to_all_at_once_and_to_who_comes_later(world: World) -> None:
    robot = world.robot()
    world.run(SETTLED_S)
    assert [welcome.crl for welcome in robot.welcomes] == [b""]
    for crl in (b"first", b"first", b"second"):
        world.core.relay_revocations(crl, world.now)
        world.dispatch()
    assert [welcome.crl for welcome in robot.welcomes] == [b"", b"first", b"second"]
    assert world.cloud("a").welcomes[0].crl == b"second"


@pytest.mark.audit("ops-19")
def test_a_large_fleet_learns_of_a_revocation_list_in_turns_and_nobody_is_left_out(
    world: World, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(control, "TOLD_AT_ONCE", 3)
    robots = [world.robot(f"robot-{number}") for number in range(10)]
    world.run(SETTLED_S)

    def told(crl: bytes) -> int:
        return sum(robot.welcomes[-1].crl == crl for robot in robots)

    world.core.relay_revocations(b"first", world.now)
    world.dispatch()
    assert told(b"first") == 3
    timer = world.core.next_timer()
    assert timer is not None
    assert timer <= world.now, "it goes on at once"
    world.step()
    assert told(b"first") == 6
    world.core.relay_revocations(b"second", world.now)
    for _ in range(4):
        world.step()
    assert told(b"second") == 10
