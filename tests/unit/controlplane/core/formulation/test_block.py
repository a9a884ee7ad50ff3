"""Which pairs become candidates, and why some uses become no block at all."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING

import pytest

from plr.controlplane.core.estimate.estimator import Estimator
from plr.controlplane.core.estimate.penalties import LONGEST_S
from plr.controlplane.core.formulation.block import BlockNotes, Picture
from plr.controlplane.core.formulation.problem_builder import Drawing
from plr.controlplane.core.policy.path_rules import PathRule
from plr.controlplane.core.policy.permits import Permits
from plr.controlplane.core.policy.policy import CallRule, OfferRule, Policy
from plr.controlplane.core.problem.objectives import joint_miss
from plr.controlplane.core.problem.problem import BlockKey, FleetKey, Objective, Target
from plr.controlplane.core.registry.registry import Sidecar
from plr.protos.model.ids import InterfaceName, NodeName, Role, ServiceName
from plr.protos.model.mapping import Assignment
from plr.protos.model.members import Candidate, Copies, InterfaceLabel, ServiceOffer, ServiceSet, ServiceUse
from plr.protos.model.report import JointReport, PathReport, PenaltyReport, Report
from tests.support.samples import (
    PLAN,
    candidate,
    histogram,
    interfaces,
    latency,
    offer,
    path,
    registration,
    stream,
    use,
)

if TYPE_CHECKING:
    from collections.abc import Sequence

KEY = BlockKey(NodeName("robot"), PLAN)


def robot(*uses: ServiceUse, candidates: tuple[Candidate, ...] = interfaces("wlan0", "wwan0")) -> Sidecar:
    return Sidecar(registration("robot"), stream(1), candidates, ServiceSet((), uses or (use(),)))


def cloud(name: str, *offers: ServiceOffer, draining: bool = False) -> Sidecar:
    services = ServiceSet(offers or (offer(),))
    offered = frozenset(offer.name for offer in services.offers)
    return Sidecar(registration(name, Role.CLOUD), stream(2), interfaces("eth0"), services, draining, offered)


def picture(
    *sidecars: Sidecar,
    paths: tuple[PathReport, ...] = (),
    capacity: int = 1,
    policy: Policy | None = None,
    path_rules: Sequence[PathRule] = (),
) -> Picture:
    estimator = Estimator(half_life_s=60.0)
    if paths:
        estimator.merge(NodeName("robot"), Report(paths=paths), 0.0)
    return drawn_by(estimator, *sidecars, capacity=capacity, policy=policy, path_rules=path_rules)


def drawn_by(
    estimator: Estimator,
    *sidecars: Sidecar,
    capacity: int = 1,
    policy: Policy | None = None,
    path_rules: Sequence[PathRule] = (),
) -> Picture:
    drawing = Drawing(default_capacity_interfaces=capacity, objective=Objective.SUM, path_rules=path_rules)
    assert drawing.advance(sidecars, Permits(policy), estimator, 0.0)
    return drawing.picture()


def test_only_paths_that_are_up_are_candidates() -> None:
    drawn = picture(
        robot(),
        cloud("a"),
        cloud("b"),
        paths=(
            path("wlan0", "a", rtt=histogram(0.02, times=50)),
            path("wlan0", "b"),
            path("wwan0", "a", up=False),
            path("wwan0", "b", rtt=histogram(0.2, times=50)),
        ),
    )
    (block,) = drawn.problem.blocks
    assert block.key == KEY
    assert (block.interfaces, block.servers) == (("wlan0", "wwan0"), ("a", "b"))
    assert block.epsilon[0][0] is not None
    assert block.epsilon[0][0] < 0.05
    assert block.epsilon[0][1] == pytest.approx(0.25), "not probed yet: as another path of its interface, in doubt"
    assert block.epsilon[1][0] is None
    assert block.epsilon[1][1] is not None
    assert block.epsilon[1][1] > 0.9
    probed, guessed = block.estimate((0, 0)), block.estimate((0, 1))
    assert probed is not None
    assert guessed is not None
    assert guessed.mean == 0.25
    assert probed.mean == pytest.approx(block.epsilon[0][0])
    assert probed.weight >= guessed.weight
    assert block.estimate((1, 0)) is None
    assert drawn.notes[KEY] == BlockNotes(servers=(NodeName("a"), NodeName("b")))


def test_a_dark_interface_and_an_unreached_server_are_left_out() -> None:
    drawn = picture(robot(), cloud("a"), cloud("b"), paths=(path("wlan0", "a"), path("wwan0", "a", up=False)))
    (block,) = drawn.problem.blocks
    assert (block.interfaces, block.servers) == (("wlan0",), ("a",))
    assert drawn.notes[KEY].dark == ("wwan0",)
    assert drawn.notes[KEY].servers == ("a", "b")
    assert not drawn.notes[KEY].all_dark


def test_with_nothing_up_every_pair_is_let_in() -> None:
    drawn = picture(robot(), cloud("a"), cloud("b"), paths=(path("wlan0", "a", up=False),))
    (block,) = drawn.problem.blocks
    assert (block.interfaces, block.servers) == (("wlan0", "wwan0"), ("a", "b"))
    assert all(epsilon is not None for row in block.epsilon for epsilon in row)
    assert drawn.notes[KEY].all_dark


@pytest.mark.parametrize(
    "server",
    [
        cloud("a", offer("/other")),
        cloud("a", offer(type_="std_srvs/srv/Trigger")),
        cloud("a", draining=True),
    ],
)
def test_a_use_that_no_live_server_offers_is_no_block(server: Sidecar) -> None:
    drawn = picture(robot(), server)
    assert drawn.problem.blocks == ()
    assert "no live server" in drawn.notes[KEY].unserved


def test_a_robot_without_addresses_is_no_block() -> None:
    drawn = picture(robot(candidates=()), cloud("a"))
    assert drawn.problem.blocks == ()
    assert "address" in drawn.notes[KEY].unserved


def test_several_addresses_of_an_interface_are_one_interface() -> None:
    twice = (candidate("wlan0", ip="10.0.0.1"), candidate("wlan0", ip="10.0.0.2"))
    (block,) = picture(robot(candidates=twice), cloud("a")).problem.blocks
    assert block.interfaces == ("wlan0",)


def test_capacities_come_from_the_configuration_and_from_the_offers() -> None:
    drawn = picture(
        robot(use(idempotent=False)), cloud("a", offer(capacity=3)), cloud("b", offer(capacity=0)), capacity=2
    )
    (block,) = drawn.problem.blocks
    assert block.capacity == 2
    assert not block.idempotent
    assert drawn.problem.fleet_capacity == {FleetKey(NodeName("a"), PLAN): 3}


def test_paths_that_were_seen_to_fail_together_get_a_lift_whatever_the_order_of_their_names() -> None:
    estimator = Estimator(half_life_s=60.0)
    # One request in ten misses on each path, and always on both.
    tenth = histogram(*[0.01] * 9, 0.5, times=50)
    pairs = (("wlan0", "a"), ("wwan0", "b"))
    joint = JointReport(PLAN, assignment("wlan0", "a"), assignment("wwan0", "b"), 4000, 400)
    gone = JointReport(PLAN, assignment("usb0", "a"), assignment("wlan0", "a"), 4000, 400)
    same = JointReport(PLAN, assignment("wlan0", "a"), assignment("wlan0", "b"), 4000, 400)
    estimator.merge(
        NodeName("robot"),
        Report(
            latencies=tuple(latency(*pair, tenth) for pair in pairs),
            paths=tuple(path(interface, server) for interface in ("wlan0", "wwan0") for server in ("a", "b")),
            joints=(joint, gone, same),
        ),
        0.0,
    )
    backwards = robot(candidates=interfaces("wwan0", "wlan0"))
    seen = [backwards, cloud("a"), cloud("b")]
    drawn = drawn_by(estimator, *seen)
    (block,) = drawn.problem.blocks
    assert block.interfaces == ("wwan0", "wlan0")
    assert block.lifts == {((0, 1), (1, 0)): pytest.approx(10.0, rel=0.1)}
    assert joint_miss(block, (1, 0)) == pytest.approx(0.1, rel=0.05)
    assert joint_miss(block, (0, 1)) == pytest.approx(0.3**2), "never tried, alone or together"


def assignment(interface: str, server: str) -> Assignment:
    return Assignment(InterfaceName(interface), NodeName(server))


def test_labels_charges_and_wishes_become_rules_of_the_block() -> None:
    wish = dataclasses.replace(use(), copies=Copies(1, 2), target_miss=0.01)
    labels = (InterfaceLabel(InterfaceName("wwan0"), "telekom", 2.0),)
    here = dataclasses.replace(robot(wish), labels=labels)
    away = cloud("b", dataclasses.replace(offer(), cost_per_request=0.5))
    far = dataclasses.replace(away, registration=dataclasses.replace(away.registration, region="eu"))
    (block,) = picture(here, cloud("a"), far).problem.blocks
    assert (block.carriers, block.regions, block.copies) == (("", "telekom"), ("", "eu"), Copies(1, 2))
    assert block.target == Target(0.01, ((1.0, 1.5), (2.0, 2.5)))
    (plain,) = picture(robot(), cloud("a")).problem.blocks
    assert (plain.carriers, plain.regions, plain.target) == ((), (), None)


def test_pairs_that_the_path_rules_bar_are_no_candidates() -> None:
    no_satellite = PathRule(("robot",), ("sat*",), ("*",), allow=False)
    only_a = [
        PathRule(("ro*",), ("wwan0",), ("a",), allow=True),
        PathRule(("*",), ("wwan0",), ("*",), allow=False),
        no_satellite,
    ]
    here = robot(candidates=interfaces("wlan0", "wwan0", "sat0"))
    drawn = picture(here, cloud("a"), cloud("b"), path_rules=only_a)
    (block,) = drawn.problem.blocks
    assert block.interfaces == ("wlan0", "wwan0")
    assert [[epsilon is not None for epsilon in row] for row in block.epsilon] == [[True, True], [True, False]]
    assert drawn.notes[KEY].dark == ()
    nothing = picture(robot(candidates=interfaces("sat0")), cloud("a"), path_rules=[no_satellite])
    assert nothing.problem.blocks == ()
    assert nothing.notes[KEY].unserved == "the path rules let this robot use no path to a live server"


def penalised(*servers: str) -> Report:
    return Report(penalties=tuple(PenaltyReport(NodeName(server), 10.0) for server in servers))


@pytest.mark.audit("sec-2")
def test_servers_that_the_robot_penalises_are_no_candidates_while_there_are_others() -> None:
    estimator = Estimator(half_life_s=60.0)
    paths = Report(paths=(path("wlan0", "a"), path("wlan0", "b"), path("wwan0", "b"), path("eth0", "a", up=False)))
    estimator.merge(NodeName("robot"), paths, 0.0)
    here = robot(candidates=interfaces("wlan0", "wwan0", "eth0"))
    assert estimator.merge(NodeName("robot"), penalised("b"), 0.0), "to be drawn at once"
    assert not estimator.merge(NodeName("robot"), penalised("b"), 0.0)
    drawn = drawn_by(estimator, here, cloud("a"), cloud("b"))
    (block,) = drawn.problem.blocks
    assert (block.interfaces, block.servers) == (("wlan0",), ("a",))
    assert drawn.notes[KEY] == BlockNotes(
        (NodeName("a"), NodeName("b")), (InterfaceName("eth0"),), penalised=(NodeName("b"),)
    )
    assert estimator.merge(NodeName("robot"), penalised("b", "a"), 0.0)
    drawn = drawn_by(estimator, here, cloud("a"), cloud("b"))
    (block,) = drawn.problem.blocks
    assert (block.interfaces, block.servers) == (("wlan0", "wwan0"), ("a", "b")), "one must be asked"
    assert drawn.notes[KEY].penalised == ()
    assert estimator.merge(NodeName("robot"), penalised(), 0.0)
    (block,) = drawn_by(estimator, here, cloud("a"), cloud("b")).problem.blocks
    assert block.servers == ("a", "b")


@pytest.mark.audit("sec-2")
def test_no_robot_penalises_a_server_for_ever() -> None:
    estimator = Estimator(half_life_s=60.0)
    told = Report(penalties=(PenaltyReport(NodeName("b"), 1e9), PenaltyReport(NodeName("a"), 0.0)))
    estimator.merge(NodeName("robot"), told, 0.0)
    assert estimator.penalties(NodeName("robot"), LONGEST_S - 1.0).keys() == {"b"}
    assert estimator.penalties(NodeName("robot"), LONGEST_S) == {}
    assert estimator.penalties(NodeName("other"), 0.0) == {}


def test_each_use_has_its_own_deadline() -> None:
    estimator_paths = (path("wlan0", "a", rtt=histogram(0.05, times=100)),)
    slow, fast = use("/slow", deadline_s=1.0), use("/fast", deadline_s=0.02)
    drawn = picture(robot(slow, fast), cloud("a", offer("/slow"), offer("/fast")), paths=estimator_paths)
    epsilon = {block.key.service: block.epsilon[0][0] for block in drawn.problem.blocks}
    assert epsilon[slow.name] == pytest.approx(0.005, abs=0.002)
    assert epsilon[fast.name] == pytest.approx(0.995, abs=0.002)


def test_servers_that_the_policy_keeps_from_a_robot_are_no_candidates() -> None:
    policy = Policy((CallRule(("robot",), ("*",), ("a", "c")),), (OfferRule(("a", "b"), ("*",)),))
    drawn = picture(robot(), cloud("a"), cloud("b"), cloud("c"), policy=policy)
    (block,) = drawn.problem.blocks
    assert block.servers == ("a",)
    assert drawn.notes[KEY].servers == ("a",)


def test_a_use_that_the_policy_lets_nowhere_says_so() -> None:
    drawn = picture(robot(use(), use("/other")), cloud("a"), policy=Policy())
    assert drawn.problem.blocks == ()
    assert drawn.notes[KEY].unserved == "the access policy lets this robot call it on no live server"
    assert "no live server offers it" in drawn.notes[BlockKey(NodeName("robot"), ServiceName("/other"))].unserved
