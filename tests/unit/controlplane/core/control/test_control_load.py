"""A large fleet at the core: what is told when, and how much is done in one go."""

from __future__ import annotations

import itertools
from typing import TYPE_CHECKING

import pytest

from plr.controlplane.core.control import control
from plr.controlplane.core.estimate.estimator import Estimator
from plr.controlplane.core.formulation import problem_builder
from plr.controlplane.core.policy.policy import Policy
from plr.controlplane.core.publish import views
from plr.controlplane.core.publish.publisher import INFORM_S
from plr.protos.model.fleet_events import Why
from plr.protos.model.ids import NodeName
from plr.protos.model.mapping import MappingSet
from plr.protos.model.members import PeerSet
from plr.protos.model.stream import Heartbeat
from tests.support.control_world import SETTLED_S
from tests.support.samples import path

if TYPE_CHECKING:
    from tests.support.control_world import SimSidecar, World

ROBOTS = 60


def fleet(world: World) -> list[SimSidecar]:
    world.cloud("a"), world.cloud("b")
    robots = [world.robot(f"robot-{number:03}") for number in range(ROBOTS)]
    world.run(SETTLED_S)
    for robot in robots:
        world.all_up(robot, ("a", "b"))
    world.run(SETTLED_S)
    return robots


@pytest.mark.audit("ops-18")
def test_those_registered_learn_of_a_longer_interval_when_they_speak(world: World) -> None:
    robots = fleet(world)
    assert robots[0].welcomes[0].report_interval_s == 0.5
    assert robots[0].welcomes[-1].report_interval_s > 0.5
    assert robots[0].welcomes[-1].lease_s == max(world.settings.lease_s, 3 * robots[0].welcomes[-1].report_interval_s)
    before = len(robots[0].welcomes)
    world.say(robots[0], Heartbeat())
    assert len(robots[0].welcomes) == before


@pytest.mark.audit("ops-18")
def test_a_lease_is_as_long_as_the_sidecar_was_told(world: World) -> None:
    robots = fleet(world)
    name = robots[0].name
    told = robots[0].welcomes[-1].lease_s
    assert world.core.registry.told_lease_s(name) == told
    world.say(robots[0], Heartbeat())
    assert world.core.registry.lease_end(name) == pytest.approx(world.now + told)


@pytest.mark.audit("ops-19")
def test_a_publication_takes_turns_and_reaches_all(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    robots = fleet(world)
    monkeypatch.setattr(control, "PUBLISHED_AT_ONCE", 7)
    for robot in robots:
        robot.received.clear()
    world.cloud("c")
    turns = 0
    most = 0
    for _ in range(200):
        timer = world.core.next_timer()
        assert timer is not None
        world.now = max(world.now, min(timer, world.now + 0.05))
        before = sum(len(robot.received) for robot in robots)
        world.core.handle_timer(world.now)
        world.dispatch()
        told = sum(len(robot.peer_sets) + len(robot.mapping_sets) for robot in robots)
        most = max(most, sum(len(robot.received) for robot in robots) - before)
        turns += most > 0
        if told >= ROBOTS and all(robot.peer_sets for robot in robots):
            break
    assert all("c" in robot.peer_names for robot in robots)
    assert turns > ROBOTS / 8
    assert most <= 2 * 8


@pytest.mark.audit("ops-20")
def test_a_dead_server_costs_no_new_estimates(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    robots = fleet(world)
    assert {*robots[0].pairs().values()} == {"a", "b"}
    estimated = []
    estimate = Estimator.estimate

    def counting(self: Estimator, *asked: object) -> object:
        estimated.append(asked)
        return estimate(self, *asked)  # type: ignore[arg-type]  # passed through

    monkeypatch.setattr(Estimator, "estimate", counting)
    monkeypatch.setattr(problem_builder, "ROUTINE_PAIRS", 0)
    for robot in robots:
        world.report(
            robot, *(path(nic, server, up=server != "a") for nic in ("wlan0", "wwan0") for server in ("a", "b"))
        )
    world.run(0.2)
    assert all({*robot.pairs().values()} == {"b"} for robot in robots)
    # One robot may be drawn as a matter of routine.
    assert len(estimated) <= 8


@pytest.mark.audit("ops-19")
def test_nobody_is_told_again_what_did_not_change(world: World) -> None:
    robots = fleet(world)
    world.run(INFORM_S)
    clouds = [sidecar for sidecar in world.sidecars.values() if sidecar not in robots]
    for sidecar in world.sidecars.values():
        sidecar.received.clear()
    world.robot("another")
    world.run(SETTLED_S)
    assert all(len(cloud.peer_sets) == 1 for cloud in clouds)
    assert not [one for robot in robots for one in robot.received if isinstance(one, PeerSet | MappingSet)]


@pytest.mark.audit("ops-20")
def test_what_is_urgent_is_not_solved_as_long_as_the_routine(world: World) -> None:
    robots = fleet(world)
    solving = [world.core.solves_routinely]
    for turn in range(200):
        if turn % 10 == 0:
            world.report(robots[0], path("wlan0", "a", up=bool(turn % 20)))
        else:
            world.report(robots[1], path("wlan0", "a"))
        world.run(0.05)
        solving.append(world.core.solves_routinely)
    assert 10 < sum(before != after for before, after in itertools.pairwise(solving))


@pytest.mark.audit("ops-20")
def test_a_robot_whose_paths_flap_all_the_time_waits_for_the_routine_and_others_do_not(world: World) -> None:
    robots = fleet(world)
    flapping, honest = robots[0], robots[1]
    solved = world.core.counters.solved
    for turn in range(400):
        up = bool(turn % 2)
        world.report(flapping, path("wlan0", "a", up=up), path("wlan0", "b", up=up))
        world.run(0.02)
    assert world.core.urgency.held > 100
    # 50 at once, some more within these 8 s, and the routine ones.
    assert world.core.counters.solved - solved < 100
    (before,) = honest.services
    chosen = before.assignments[0]
    world.report(honest, path(chosen.interface, chosen.server, up=False))
    world.run(0.1)
    (after,) = honest.services
    assert chosen not in after.assignments


def test_a_new_policy_is_told_of_in_turns(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    fleet(world)
    monkeypatch.setattr(control, "JUDGED_AT_ONCE", 7)
    world.core.set_policy(Policy(), world.now)

    def told() -> int:
        return sum(gone.why is Why.POLICY for gone in world.core.departed)

    assert told() == 7
    for turns in itertools.count(1):
        timer = world.core.next_timer()
        assert timer is not None
        world.core.handle_timer(world.now)
        assert told() <= 7 * (1 + turns)
        if told() == ROBOTS + 2:
            break
        assert timer <= world.now, "it goes on at once"
    world.core.set_policy(None, world.now)
    world.run(SETTLED_S)
    assert told() == 0


def test_who_has_many_peers_counts_for_more(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    robots = fleet(world)
    cloud, robot = (world.core.registry.get(NodeName(name)) for name in ("a", robots[0].name))
    monkeypatch.setattr(views, "PEERS_OF_A_LOOK", 10)
    made = views.Views(world.core.registry, world.core.permits, views.KnownPeers())
    assert len(list(made.looks(cloud))) == 1 + ROBOTS // 10
    assert len(list(made.looks(robot))) == len(list(made.looks(None))) == 1
