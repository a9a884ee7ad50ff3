"""Which robots are drawn again, and when a block counts as the same."""

from __future__ import annotations

import random
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import pytest

from plr.controlplane.core.estimate.estimator import Estimator
from plr.controlplane.core.formulation import problem_builder
from plr.controlplane.core.formulation.block import KEPT_PAIRS
from plr.controlplane.core.formulation.problem_builder import (
    EPSILON_SHARE,
    FEW_ROBOTS,
    LIFT_SHARE,
    MAX_CONSIDERED_INTERFACES,
    ROBOT_PAIRS,
    ROUTINE_PAIRS,
    SLICE_PAIRS,
    STALE_S,
    SURPRISE_MISSES,
    URGENT_SHARE,
    WEIGHT_SHARE,
    Drawing,
    is_alike,
)
from plr.controlplane.core.policy.path_rules import PathRule, PathRules
from plr.controlplane.core.policy.permits import Group, Permits
from plr.controlplane.core.policy.policy import CallRule, OfferRule, Policy
from plr.controlplane.core.problem.problem import Block, BlockKey, Objective
from plr.controlplane.core.registry.registry import Sidecar
from plr.protos.model.ids import InterfaceName, NodeName, Role, ServiceName
from plr.protos.model.members import CallPermit, InterfaceLabel, ServiceOffer, ServiceSet
from plr.protos.model.report import Report
from tests.support.samples import PLAN, histogram, interfaces, latency, offer, path, registration, stream, use

if TYPE_CHECKING:
    from collections.abc import Mapping

ALL_UP = tuple(path(interface, server) for interface in ("wlan0", "wwan0") for server in ("a", "b"))
ONE_DOWN = (path("wlan0", "a", up=False), *ALL_UP[1:])


class Fleet:
    """Robots with two interfaces, two clouds, and the drawing of them."""

    def __init__(self, robots: int) -> None:
        self.now = 0.0
        self.names = [NodeName(f"robot-{number:04d}") for number in range(robots)]
        self.estimator = Estimator(half_life_s=60.0)
        self.drawing = Drawing(default_capacity_interfaces=1, objective=Objective.JOINT)
        self.permits = Permits(None)
        self.robots = [
            Sidecar(registration(name), stream(2), interfaces("wlan0", "wwan0"), ServiceSet((), (use(),)))
            for name in self.names
        ]
        self.sidecars = [self._cloud(name) for name in ("a", "b")] + self.robots
        for name in self.names:
            self.report(name, Report(paths=ALL_UP))
        self.draw(routine=True)

    def _cloud(self, name: str) -> Sidecar:
        services = ServiceSet((offer(),))
        return Sidecar(registration(name, Role.CLOUD), stream(1), interfaces("eth0"), services)

    def report(self, robot: NodeName, report: Report) -> None:
        changed = self.estimator.merge(robot, report, self.now)
        if self.drawing.reported(robot, report) or changed:
            self.drawing.robot_changed(robot)

    def draw(self, *, routine: bool) -> int:
        """All that is urgent, in as many pictures as that takes; returns in how many slices."""
        slices = 0
        while True:
            slices += self.draw_one(routine=routine)
            if not self.drawing.urgent_left:
                return slices

    def draw_one(self, *, routine: bool, lost: Mapping[NodeName, float] | None = None) -> int:
        """One picture; returns in how many slices."""
        self.drawing.begin(routine=routine)
        return self.finish(lost)

    def finish(self, lost: Mapping[NodeName, float] | None = None) -> int:
        share = {} if lost is None else lost
        slices = 1
        while not self.drawing.advance(
            self.sidecars, self.permits, self.estimator, self.now, lambda robot: share.get(robot, 0.0)
        ):
            slices += 1
        return slices

    def blocks(self) -> dict[NodeName, Block]:
        return {block.key.robot: block for block in self.drawing.picture().problem.blocks}

    def moved(self, before: dict[NodeName, Block]) -> set[NodeName]:
        return {name for name, block in self.blocks().items() if block is not before.get(name)}


def missed(times: int) -> Report:
    return Report((latency("wlan0", "a", histogram(1.0, times=times)),), ALL_UP)


def test_a_dead_path_and_unexpected_misses_draw_their_robots_alone_at_once() -> None:
    fleet = Fleet(4)
    before = fleet.blocks()
    fleet.report(fleet.names[1], Report(paths=ONE_DOWN))
    fleet.report(fleet.names[2], missed(int(SURPRISE_MISSES) * 2))
    fleet.report(fleet.names[3], Report((latency("wlan0", "a", histogram(0.01, times=50)),), ALL_UP))
    fleet.draw(routine=False)
    assert fleet.moved(before) == set(fleet.names[1:3])
    fleet.draw(routine=True)
    assert fleet.moved(before) == set(fleet.names[1:])
    fleet.report(fleet.names[2], missed(1))
    before = fleet.blocks()
    fleet.draw(routine=False)
    assert not fleet.moved(before), "as expected by now"


@pytest.mark.parametrize("robots", [FEW_ROBOTS, FEW_ROBOTS + 1])
def test_a_changed_path_brings_its_news_at_once_unless_many_changed(robots: int) -> None:
    """What else its report tells is estimated with it; of many, at the next routine drawing."""
    fleet = Fleet(robots)
    before = fleet.blocks()
    for name in fleet.names:
        told = Report((latency("wwan0", "b", histogram(0.01, times=50)),), ONE_DOWN)
        fleet.estimator.merge(name, told, fleet.now)
        fleet.drawing.reported(name, told)
        fleet.drawing.robot_changed(name, estimate_again=False)
    fleet.draw(routine=False)
    assert all(block.epsilon[0][0] is None for block in fleet.blocks().values()), "the path is down for all"
    at_once = [block.epsilon[1][1] != before[name].epsilon[1][1] for name, block in fleet.blocks().items()]
    assert all(at_once) if robots == FEW_ROBOTS else not any(at_once)
    fleet.draw(routine=True)
    assert all(block.epsilon[1][1] != before[name].epsilon[1][1] for name, block in fleet.blocks().items())


def test_blocks_whose_estimates_stay_are_the_same_objects() -> None:
    fleet = Fleet(2)
    good = Report((latency("wlan0", "a", histogram(0.01, times=200)),), ALL_UP)
    for _ in range(20):
        fleet.report(fleet.names[0], good)
    fleet.draw(routine=True)
    before = fleet.blocks()
    fleet.report(fleet.names[0], Report((latency("wlan0", "a", histogram(0.01)),), ALL_UP))
    fleet.draw(routine=True)
    assert not fleet.moved(before)


def test_a_change_of_the_members_draws_those_it_concerns() -> None:
    fleet = Fleet(2)
    before = fleet.blocks()
    fleet.drawing.members_changed()
    fleet.draw(routine=False)
    assert not fleet.moved(before), "nothing about the robots changed"
    fleet.sidecars[2] = replace(fleet.sidecars[2], candidates=interfaces("wlan0"))
    del fleet.sidecars[3]
    fleet.drawing.members_changed()
    fleet.draw(routine=False)
    assert fleet.moved(before) == {fleet.names[0]}
    assert set(fleet.blocks()) == {fleet.names[0]}
    assert fleet.blocks()[fleet.names[0]].interfaces == ("wlan0",)


def test_a_large_fleet_is_drawn_in_slices_a_part_at_a_time() -> None:
    pairs = 4
    at_once = ROUTINE_PAIRS // pairs
    fleet = Fleet(at_once + 40)
    before = fleet.blocks()
    fleet.now = 1.0
    for name in fleet.names:
        fleet.report(name, Report((latency("wlan0", "a", histogram(0.01, times=9)),), ALL_UP))
    slices = ROUTINE_PAIRS // SLICE_PAIRS
    assert slices <= fleet.draw(routine=True) <= slices + 1
    assert len(fleet.moved(before)) == at_once
    fleet.draw(routine=True)
    assert fleet.moved(before) == set(fleet.names)


def test_robots_that_say_nothing_are_drawn_now_and_then() -> None:
    fleet = Fleet(1)
    fleet.report(fleet.names[0], missed(50))
    fleet.draw(routine=True)
    before = fleet.blocks()
    fleet.now = STALE_S - 1.0
    fleet.draw(routine=True)
    assert not fleet.moved(before)
    fleet.now = STALE_S * 3
    fleet.draw(routine=True)
    assert fleet.moved(before)


BLOCK = Block(
    BlockKey(NodeName("robot"), PLAN),
    (InterfaceName("wlan0"), InterfaceName("wwan0")),
    (NodeName("a"), NodeName("b")),
    ((0.1, None), (0.2, 0.3)),
    lifts={((0, 0), (1, 1)): 2.0},
    weights=((10.0, 0.0), (10.0, 10.0)),
)


@pytest.mark.parametrize("sign", [-1, 1])
@pytest.mark.parametrize(("times", "alike"), [(0.9, True), (1.1, False)])
def test_a_little_is_nothing(sign: int, times: float, alike: bool) -> None:
    def moved(share: float) -> float:
        return 1.0 + sign * times * share

    epsilon = ((0.1, None), (0.2 * moved(EPSILON_SHARE), 0.3))
    lifts = {((0, 0), (1, 1)): 2.0 * moved(LIFT_SHARE)}
    weights = ((10.0 * moved(WEIGHT_SHARE), 0.0), (10.0, 10.0))
    assert is_alike(replace(BLOCK, epsilon=epsilon), BLOCK) is alike
    assert is_alike(replace(BLOCK, lifts=lifts), BLOCK) is alike
    assert is_alike(replace(BLOCK, weights=weights), BLOCK) is alike


@pytest.mark.parametrize(
    "other",
    [
        replace(BLOCK, epsilon=((0.1, 0.1), (0.2, 0.3))),
        replace(BLOCK, epsilon=((None, 0.1), (0.2, 0.3))),
        replace(BLOCK, lifts={}),
        replace(BLOCK, weights=()),
        replace(BLOCK, capacity=2),
        replace(BLOCK, servers=(NodeName("a"), NodeName("c"))),
    ],
)
def test_another_shape_is_another_block(other: Block) -> None:
    assert not is_alike(other, BLOCK)
    assert not is_alike(BLOCK, other)


@pytest.mark.audit("sec-10")
def test_one_robot_with_many_services_is_drawn_in_slices_too() -> None:
    fleet = Fleet(robots=1)
    services = 2 * SLICE_PAIRS // 4
    uses = tuple(replace(use(), name=ServiceName(f"/service_{number}")) for number in range(services))
    clouds = ("a", "b")
    offers = tuple(replace(offer(), name=ServiceName(f"/service_{number}")) for number in range(services))
    fleet.sidecars = [
        replace(fleet._cloud(name), services=ServiceSet(offers), offered=frozenset(one.name for one in offers))
        for name in clouds
    ] + [Sidecar(registration(fleet.names[0]), stream(2), interfaces("wlan0", "wwan0"), ServiceSet((), uses))]
    fleet.drawing.members_changed()
    assert fleet.draw(routine=True) >= 2
    assert len(fleet.drawing.picture().problem.blocks) == services
    # What changes in the middle of it is drawn with the change.
    fleet.drawing.robot_changed(fleet.names[0])
    fleet.drawing.begin(routine=False)
    assert not fleet.drawing.advance(fleet.sidecars, fleet.permits, fleet.estimator, fleet.now)
    fleet.sidecars = fleet.sidecars[1:]
    fleet.drawing.members_changed()
    while not fleet.drawing.advance(fleet.sidecars, fleet.permits, fleet.estimator, fleet.now):
        pass
    assert {block.servers for block in fleet.drawing.picture().problem.blocks} == {("b",)}


AT_ONCE = 40


@pytest.mark.audit("ops-20")
def test_of_many_urgent_robots_a_part_is_drawn_at_once_and_those_that_lost_most_first(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(problem_builder, "URGENT_AT_ONCE", AT_ONCE)
    fleet = Fleet(3 * AT_ONCE)
    before = fleet.blocks()
    for name in fleet.names:
        fleet.report(name, Report(paths=ONE_DOWN))
    lost = {name: 1.0 for name in fleet.names[70:][:AT_ONCE]}
    fleet.draw_one(routine=False, lost=lost)
    assert fleet.moved(before) == lost.keys()
    assert fleet.drawing.urgent_left
    fleet.draw_one(routine=False)
    assert fleet.moved(before) == {*lost, *fleet.names[:AT_ONCE]}, "then those that waited longest"
    fleet.draw(routine=False)
    assert fleet.moved(before) == set(fleet.names)
    assert not fleet.drawing.urgent_left


@pytest.mark.audit("ops-20")
def test_of_very_many_a_share_is_drawn_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(problem_builder, "URGENT_AT_ONCE", AT_ONCE)
    fleet = Fleet(8 * AT_ONCE)
    before = fleet.blocks()
    for name in fleet.names:
        fleet.report(name, Report(paths=ONE_DOWN))
    fleet.draw_one(routine=False)
    assert len(fleet.moved(before)) == round(URGENT_SHARE * len(fleet.names)) > AT_ONCE


@pytest.mark.audit("ops-20")
def test_urgent_robots_keep_no_others_from_being_drawn() -> None:
    fleet = Fleet(40)
    fleet.now = STALE_S / 2
    for name in fleet.names:
        fleet.report(name, Report((latency("wwan0", "b", histogram(0.01, times=50)),), ALL_UP))
    flapping = fleet.names[0]
    before = fleet.blocks()
    for turn in range(20):
        fleet.report(flapping, Report(paths=ONE_DOWN if turn % 2 else ALL_UP))
        fleet.draw_one(routine=True)
        if fleet.moved(before) == set(fleet.names):
            return
    raise AssertionError(f"only {len(fleet.moved(before))} were drawn")


# ── who could call what where ──

ALLOWED = (
    None,
    Policy((CallRule(("robot-0*",), ("*",), ("a", "c")),), (OfferRule(("*",), ("*",)),)),
    Policy((CallRule(("*",), ("*",), ("*",)),), (OfferRule(("a",), ("*",)),)),
)


def change_one(rng: random.Random, fleet: Fleet) -> None:
    """Somebody comes, goes, or tells something else; or nothing that matters changes."""
    place = rng.randrange(len(fleet.sidecars))
    was = fleet.sidecars[place]
    match rng.randrange(8):
        case 0:
            del fleet.sidecars[place]
        case 1:
            names = {sidecar.name for sidecar in fleet.sidecars}
            fleet.sidecars += [
                sidecar
                for sidecar in (cloud_of("c"), cloud_of("d", 7), *fleet.robots[-2:])
                if sidecar.name not in names
            ]
        case 2:
            fleet.permits = Permits(rng.choice(ALLOWED))
        case 3:
            fleet.sidecars[place] = replace(was, candidates=interfaces(*rng.sample(("wlan0", "wwan0", "eth0"), 2)))
        case 4:
            fleet.sidecars[place] = replace(was, draining=not was.draining)
        case 5:
            kept = () if rng.random() < 0.3 else (offer(capacity=rng.randrange(3)),)
            uses = (use(deadline_s=rng.choice((0.1, 0.2))),)
            told = ServiceSet((), uses) if was.role is Role.ROBOT else ServiceSet(kept)
            fleet.sidecars[place] = replace(was, services=told)
        case 6:
            fleet.sidecars[place] = replace(was, labels=(InterfaceLabel(InterfaceName("wlan0"), "carrier"),))
        case _:
            fleet.sidecars[place] = replace(was, stream=stream(99))


def cloud_of(name: str, capacity: int = 0) -> Sidecar:
    services = ServiceSet((offer(capacity=capacity),))
    offered = frozenset({PLAN})
    return Sidecar(registration(name, Role.CLOUD), stream(1), interfaces("eth0"), services, offered=offered)


@pytest.mark.audit("ops-18")
@pytest.mark.parametrize("seed", range(6))
def test_whoever_changes_in_whatever_order_the_picture_is_that_of_who_looks_for_the_first_time(
    seed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(problem_builder, "LOOKED_AT_ONCE", 2)
    rng = random.Random(seed)
    fleet = Fleet(8)
    fleet.sidecars[:2] = [cloud_of("a"), cloud_of("b")]
    for _ in range(60):
        change_one(rng, fleet)
        fleet.drawing.members_changed()
        fleet.drawing.begin(routine=False)
        for _ in range(rng.randrange(3)):
            fleet.drawing.advance(fleet.sidecars, fleet.permits, fleet.estimator, fleet.now)
            if rng.random() < 0.3:
                change_one(rng, fleet)
                fleet.drawing.members_changed()
        fleet.finish()
        first = Drawing(default_capacity_interfaces=1, objective=Objective.JOINT)
        first.begin(routine=False)
        while not first.advance(fleet.sidecars, fleet.permits, fleet.estimator, fleet.now):
            pass
        assert fleet.drawing.picture() == first.picture()


@pytest.mark.audit("ops-18")
def test_a_change_of_one_robot_lets_the_others_be(monkeypatch: pytest.MonkeyPatch) -> None:
    fleet = Fleet(50)
    looked_at = []
    inputs = problem_builder._inputs

    def counted(ways: problem_builder._Ways, *rest: Any) -> problem_builder._Inputs:
        looked_at.append(ways.robot.name)
        return inputs(ways, *rest)

    monkeypatch.setattr(problem_builder, "_inputs", counted)
    fleet.sidecars[7] = replace(fleet.sidecars[7], candidates=interfaces("wlan0"))
    fleet.drawing.members_changed()
    fleet.draw(routine=False)
    assert looked_at == [fleet.sidecars[7].name]
    fleet.sidecars[0] = replace(fleet.sidecars[0], stream=stream(5))
    fleet.drawing.members_changed()
    fleet.draw(routine=False)
    assert len(looked_at) == 1
    fleet.sidecars[0] = replace(fleet.sidecars[0], services=ServiceSet((offer(capacity=3),)))
    fleet.drawing.members_changed()
    fleet.draw(routine=False)
    assert len(looked_at) == 51


@pytest.mark.audit("ops-18")
def test_a_large_fleet_is_looked_at_in_several_goes() -> None:
    fleet = Fleet(2 * problem_builder.LOOKED_AT_ONCE + 1)
    fleet.permits = Permits(ALLOWED[2])
    fleet.drawing.members_changed()
    fleet.drawing.begin(routine=False)
    for _ in range(2):
        assert not fleet.drawing.advance(fleet.sidecars, fleet.permits, fleet.estimator, fleet.now)
        assert not fleet.drawing.picture().problem.blocks
    fleet.finish()
    fleet.draw(routine=False)
    assert {note.unserved for note in fleet.drawing.picture().notes.values()} == {
        "the access policy lets this robot call it on no live server"
    }


def test_under_a_policy_with_a_rule_for_each_robot_few_clouds_are_asked_in_one_go(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    clouds, robots = 50 * problem_builder.CLOUDS_A_LOOK, 20
    fleet = Fleet(robots)
    fleet.sidecars[:2] = [
        replace(fleet._cloud(f"cloud-{number:04d}"), offered=frozenset((ServiceName(PLAN),)))
        for number in range(clouds)
    ]
    rules = tuple(CallRule((name,), ("*",), ("*",)) for name in fleet.names)
    fleet.permits = Permits(Policy(rules, (OfferRule(("*",), ("*",)),)))
    asked, read, real = 0, 0, Permits.of
    inputs = problem_builder._inputs

    def of(permits: Permits, group: Group, cloud: Sidecar) -> CallPermit:
        nonlocal asked
        asked += 1
        return real(permits, group, cloud)

    def counted(*given: Any) -> problem_builder._Inputs:
        nonlocal read
        read += len(given[-1])
        return inputs(*given)

    monkeypatch.setattr(Permits, "of", of)
    monkeypatch.setattr(problem_builder, "_inputs", counted)
    fleet.drawing.members_changed()
    fleet.drawing.begin(routine=False)
    goes = 0
    while fleet.drawing._frame is None:
        before = asked + read
        fleet.drawing.advance(fleet.sidecars, fleet.permits, fleet.estimator, fleet.now)
        # The clouds of one use may come on top.
        most = problem_builder.LOOKED_AT_ONCE * problem_builder.CLOUDS_A_LOOK + clouds
        assert asked + read - before <= most
        goes += 1
    assert asked == read == robots * clouds
    assert goes > 5
    assert fleet.drawing._outdated == {}


@pytest.mark.audit("ops-19")
def test_many_services_are_looked_at_in_several_goes_and_each_once(monkeypatch: pytest.MonkeyPatch) -> None:
    services, interfaces_named = 3 * problem_builder.LOOKED_AT_ONCE, 100
    names = [ServiceName(f"/service_{number}") for number in range(services)]
    fleet = Fleet(1)
    fleet.drawing = Drawing(
        default_capacity_interfaces=1,
        objective=Objective.JOINT,
        path_rules=[PathRule(("*",), ("wlan9*",), ("*",), allow=False)],
    )
    fleet.sidecars[:2] = [
        replace(cloud, services=ServiceSet(tuple(offer(name) for name in names))) for cloud in fleet.sidecars[:2]
    ]
    fleet.sidecars[2] = replace(
        fleet.sidecars[2],
        candidates=interfaces(*(f"wlan{number}" for number in range(interfaces_named))),
        services=ServiceSet((), tuple(use(name) for name in names)),
    )
    offers_read, verdicts, reads = 0, 0, Sidecar.offers.fget  # type: ignore[attr-defined]
    allows = PathRules._allows

    def offers(sidecar: Sidecar) -> tuple[ServiceOffer, ...]:
        nonlocal offers_read
        offers_read += 1
        found: tuple[ServiceOffer, ...] = reads(sidecar)
        return found

    def counted(rules: PathRules, *pair: Any) -> bool:
        nonlocal verdicts
        verdicts += 1
        return allows(rules, *pair)

    monkeypatch.setattr(Sidecar, "offers", property(offers))
    monkeypatch.setattr(PathRules, "_allows", counted)
    fleet.drawing.begin(routine=False)
    for _ in range(services // problem_builder.LOOKED_AT_ONCE):
        assert not fleet.drawing.advance(fleet.sidecars, fleet.permits, fleet.estimator, fleet.now)
        assert fleet.drawing._frame is None
    assert not fleet.drawing.advance(fleet.sidecars, fleet.permits, fleet.estimator, fleet.now)
    assert fleet.drawing._frame is not None
    assert len(fleet.drawing._frame.uses[fleet.names[0]]) == services
    assert offers_read <= len(fleet.sidecars), "once for each cloud, not for each use"
    assert verdicts <= 2 * interfaces_named, "once for each path, not for each use"


# ── a robot with much to draw ──


def with_a_big_robot(services: int) -> tuple[Fleet, NodeName]:
    """The first of three robots has many interfaces and calls many services on two clouds."""
    fleet = Fleet(3)
    big = fleet.names[0]
    names = [ServiceName(f"/service_{number:03d}") for number in range(services)]
    offers = (offer(), *(replace(offer(), name=name) for name in names))
    fleet.sidecars[:2] = [
        replace(fleet._cloud(name), services=ServiceSet(offers), offered=frozenset(one.name for one in offers))
        for name in ("a", "b")
    ]
    ports = interfaces(*(f"if{number}" for number in range(200)))
    fleet.sidecars[2] = replace(
        fleet.sidecars[2],
        candidates=ports,
        services=ServiceSet((), tuple(replace(use(), name=name) for name in names)),
    )
    fleet.drawing.members_changed()
    fleet.draw(routine=True)
    return fleet, big


def drawn_since(fleet: Fleet, was: dict[BlockKey, Any]) -> set[BlockKey]:
    return {key for key, found in fleet.drawing._drawn.items() if found is not was.get(key)}


@pytest.mark.audit("ops-20")
def test_a_robot_with_much_to_draw_holds_up_no_other_and_all_its_services_get_their_turn() -> None:
    fleet, big = with_a_big_robot(services=12)
    most = ROBOT_PAIRS + 2 * MAX_CONSIDERED_INTERFACES + 2 * 4 * KEPT_PAIRS
    seen: set[BlockKey] = set()
    for _ in range(12):
        # It flaps before each picture, and asks to be drawn before the others.
        fleet.drawing.robot_changed(big)
        fleet.drawing.robot_changed(fleet.names[1])
        was = dict(fleet.drawing._drawn)
        slices = fleet.draw_one(routine=False)
        assert slices <= most / SLICE_PAIRS + 2
        drawn = drawn_since(fleet, was)
        assert BlockKey(fleet.names[1], PLAN) in drawn, "in the very next picture"
        assert 0 < len(drawn) < 12
        seen |= drawn
    assert len({key for key in seen if key.robot == big}) == 12
    while fleet.drawing.urgent_left:
        fleet.draw_one(routine=False)
    assert len({key for key in drawn_since(fleet, was) if key.robot == big}) == 12, "what it changed last"


@pytest.mark.audit("ops-20")
def test_what_is_left_of_a_robot_is_drawn_whoever_comes_meanwhile() -> None:
    fleet, big = with_a_big_robot(services=12)
    for routine in (False, True):
        was = dict(fleet.drawing._drawn)
        if routine:
            fleet.drawing.reported(big, Report())
        else:
            fleet.drawing.robot_changed(big)
        fleet.draw_one(routine=routine)
        assert fleet.drawing.routine_left if routine else fleet.drawing.urgent_left
        fleet.sidecars[3] = replace(fleet.sidecars[3], stream=stream(9), candidates=interfaces("eth0"))
        fleet.drawing.members_changed()
        while fleet.drawing.urgent_left or fleet.drawing.routine_left:
            fleet.draw_one(routine=routine)
        assert len({key for key in drawn_since(fleet, was) if key.robot == big}) == 12
        fleet.sidecars[3] = replace(fleet.sidecars[3], candidates=interfaces("wlan0", "wwan0"))


@pytest.mark.audit("ops-20")
def test_the_most_promising_of_many_interfaces_are_taken_and_stay() -> None:
    fleet = Fleet(1)
    robot = fleet.names[0]
    ports = [f"if{number:02d}" for number in range(33)]
    good = [ports[number] for number in (1, 4, 9, 12, 20, 25, 31, 32)]
    fleet.sidecars[2] = replace(fleet.sidecars[2], candidates=interfaces(*ports))
    fleet.report(
        robot,
        Report(
            tuple(latency(port, "a", histogram(0.01 if port in good else 1.0, times=50)) for port in ports),
            tuple(path(port, server) for port in ports for server in ("a", "b")),
        ),
    )
    fleet.drawing.members_changed()
    fleet.draw(routine=True)
    (block,) = fleet.blocks().values()
    assert list(block.interfaces) == good
    (notes,) = fleet.drawing.picture().notes.values()
    assert set(notes.surplus) == set(ports) - set(good)
    fleet.report(robot, Report((latency(ports[0], "a", histogram(0.01, times=60)),)))
    fleet.draw(routine=True)
    assert list(fleet.blocks()[robot].interfaces) == good, "one as good does not push out another"
    fleet.report(robot, Report(paths=tuple(path(good[0], server, up=False) for server in ("a", "b"))))
    fleet.draw(routine=False)
    assert list(fleet.blocks()[robot].interfaces) == [ports[0], *good[1:]], "one that is better does"
