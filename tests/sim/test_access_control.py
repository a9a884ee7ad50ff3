"""Access control over both planes: told to nobody, and refused all the same when somebody asks."""

from __future__ import annotations

import dataclasses
import functools
from typing import TYPE_CHECKING

from lab.simulated.mesh import SERVICE, TYPE, Mesh, Node, rule
from plr.controlplane.core.control.events import Settings
from plr.controlplane.core.policy.policy import CallRule, OfferRule, Policy
from plr.protos.model.ids import NodeName, Role, ServiceName
from plr.protos.model.members import ServiceOffer
from plr.sidecar.core.robot.request.service_catalog import WITHDRAW_AFTER_S
from plr.sidecar.core.seam.application import CallsForbidden, ExecuteRequest, RequestFailed, WithdrawService
from tests.sim.joined_planes import JoinedPlanes, restored

if TYPE_CHECKING:
    from plr.sidecar.core.base.values import RequestId

SECRET = ServiceName("/secret")
ANY = ("*",)
OFFER_ANY = (OfferRule(ANY, ANY),)
ECHO_FOR_ALL = CallRule(ANY, (SERVICE,), ANY)
SECRET_FOR_GOOD = CallRule(("good",), (SECRET,), ANY)
POLICY = Policy((ECHO_FOR_ALL, SECRET_FOR_GOOD), OFFER_ANY)


class Fleet:
    """Two robots that use /echo and /secret, and two clouds that offer both."""

    def __init__(self, policy: Policy | None, *, rogue: bool = False, seed: int = 1) -> None:
        self.mesh = Mesh(seed)
        rules = (rule(pattern="/*"),)
        self.good = self.mesh.add("good", Role.ROBOT, ["wlan0", "wwan0"], rules)
        self.other = self.mesh.add("other", Role.ROBOT, ["wlan0"], rules)
        self.clouds = [self.mesh.add(name, Role.CLOUD, ["eth0"], rules) for name in ("a", "b")]
        for cloud in self.clouds:
            cloud.offers = (ServiceOffer(SERVICE, TYPE), ServiceOffer(SECRET, TYPE))
            cloud.engine.cloud.set_offers(cloud.offers)
        self.planes = JoinedPlanes(self.mesh, policy)
        if rogue:
            self.planes.rogues.add(self.other.name)
        self.planes.join(*self.clouds, self.good, self.other)
        self.planes.run(3.0)

    def calls(self, seconds: float, *asked: tuple[Node, ServiceName], hertz: float = 20.0) -> list[list[RequestId]]:
        """Let robots call at a steady rate; returns the ids of each."""
        ids: list[list[RequestId]] = [[] for _ in asked]
        for number in range(int(seconds * hertz)):
            for made, (robot, service) in zip(ids, asked, strict=True):
                made.append(robot.submit(b"%s %d" % (robot.name.encode(), number), service))
            self.planes.run(1 / hertz)
        self.planes.run(1.0)
        return ids

    def ran(self, service: ServiceName) -> set[NodeName]:
        """The robots whose requests for a service reached an application."""
        events = (event for cloud in self.clouds for event in cloud.events)
        return {event.robot for event in events if isinstance(event, ExecuteRequest) and event.service == service}


def set_policy(fleet: Fleet, policy: Policy | None) -> None:
    fleet.planes.core.set_policy(policy, fleet.mesh.now)


def answered(robot: Node, ids: list[RequestId]) -> int:
    return len({response.request_id for response in robot.responses()} & set(ids))


def failures(robot: Node, ids: list[RequestId]) -> list[str]:
    return [event.reason for event in robot.events if isinstance(event, RequestFailed) and event.request_id in ids]


def test_a_robot_gets_nowhere_with_what_it_may_not_call_and_costs_the_others_nothing() -> None:
    fleet = Fleet(POLICY, rogue=True)
    good, rogue = fleet.good, fleet.other
    assert SECRET in rogue.engine.robot.catalog.offered, "the rogue must really try"
    echoes, secrets, permitted, denied = fleet.calls(
        5.0, (good, SERVICE), (good, SECRET), (rogue, SERVICE), (rogue, SECRET)
    )
    assert answered(good, echoes) == answered(good, secrets) == answered(rogue, permitted) == 100
    assert answered(rogue, denied) == 0
    reasons = failures(rogue, denied)
    assert len(reasons) == 100
    assert all("forbidden: the access policy does not let other call /secret here" in reason for reason in reasons)
    assert fleet.ran(SECRET) == {good.name}
    refused = [cloud.engine.stats.dropped["request_forbidden"] for cloud in fleet.clouds]
    assert sum(refused) >= 100
    assert rogue.engine.stats.dropped["rejected_forbidden"] == sum(refused)
    for cloud in fleet.clouds:
        notices = [event for event in cloud.events if isinstance(event, CallsForbidden)]
        assert 1 <= len(notices) <= 2
        assert notices[0] == CallsForbidden(rogue.name, SECRET, 1)


def test_an_honest_robot_does_not_even_offer_what_it_may_not_call() -> None:
    fleet = Fleet(POLICY)
    assert set(fleet.other.engine.robot.catalog.offered) == {SERVICE}
    assert set(fleet.good.engine.robot.catalog.offered) == {SERVICE, SECRET}
    assert {mapping.service for mapping in fleet.other.engine.service_mappings} == {SERVICE}


def test_who_may_call_nothing_on_a_cloud_is_a_stranger_there() -> None:
    only_good = Policy((CallRule(("good",), ANY, ANY),), OFFER_ANY)
    fleet = Fleet(only_good, rogue=True)
    echoes, strange = fleet.calls(2.0, (fleet.good, SERVICE), (fleet.other, SERVICE))
    assert answered(fleet.good, echoes) == 40
    assert answered(fleet.other, strange) == 0
    for cloud in fleet.clouds:
        assert cloud.engine.peers.names() == [fleet.good.name]
        assert not cloud.engine.stats.dropped["request_forbidden"], "it must not get as far as that"
    assert fleet.ran(SERVICE) == {fleet.good.name}


def test_an_offer_that_its_cloud_may_not_make_reaches_no_robot() -> None:
    """Cloud b is a rogue that offers a name which is not its own."""
    fleet = Fleet(Policy((CallRule(ANY, ANY, ANY),), (OfferRule(("a",), ANY), OfferRule(("b",), (SERVICE,)))))
    secrets, echoes = fleet.calls(2.0, (fleet.good, SECRET), (fleet.good, SERVICE))
    assert answered(fleet.good, secrets) == answered(fleet.good, echoes) == 40
    at_b = {event.service for event in fleet.clouds[1].events if isinstance(event, ExecuteRequest)}
    assert at_b == {SERVICE}
    assert [(notice.sidecar, notice.services) for notice in fleet.planes.refused_offers] == [("b", (SECRET,))]
    assert fleet.planes.core.counters.offers_refused == 1
    status = {status.peer.name: status for status in fleet.planes.core.status(fleet.mesh.now)}
    assert status[NodeName("b")].refused_offers == (SECRET,)
    assert status[NodeName("a")].refused_offers == ()


def test_a_change_of_the_policy_loses_no_request_that_stays_allowed() -> None:
    """Servers take longer than the change, so that requests of before, during and after it are in flight."""
    fleet = Fleet(POLICY)
    for cloud in fleet.clouds:
        cloud.server_delay = lambda: 0.12
    good, mesh = fleet.good, fleet.mesh
    without_b = Policy((CallRule(ANY, ANY, ("a",)),), OFFER_ANY)
    for delay, policy in ((1.01, without_b), (2.01, POLICY), (3.01, Policy((ECHO_FOR_ALL,), OFFER_ANY)), (4.01, None)):
        mesh.at(delay, functools.partial(set_policy, fleet, policy))
    (echoes,) = fleet.calls(5.0, (good, SERVICE), hertz=50.0)
    assert answered(good, echoes) == 250
    assert failures(good, echoes) == []


def test_what_is_forbidden_in_mid_run_stops_and_what_is_allowed_again_comes_back() -> None:
    fleet = Fleet(POLICY)
    b = fleet.clouds[1]
    set_policy(fleet, Policy((CallRule(ANY, ANY, ("a",)),), OFFER_ANY))
    fleet.planes.run(0.2)
    ran_before = len(b.executed)
    assert b.engine.peers.names() == []
    (echoes,) = fleet.calls(2.0, (fleet.good, SERVICE))
    assert answered(fleet.good, echoes) == 40
    assert len(b.executed) == ran_before
    set_policy(fleet, POLICY)
    fleet.planes.run(1.0)
    fleet.calls(2.0, (fleet.good, SERVICE))
    assert len(b.executed) > ran_before


def test_a_service_forbidden_in_mid_run_is_withdrawn_and_what_runs_already_is_answered() -> None:
    fleet = Fleet(POLICY)
    good = fleet.good
    for cloud in fleet.clouds:
        cloud.server_delay = lambda: 0.5
    request = good.submit(b"last", SECRET)
    fleet.planes.run(0.1)
    set_policy(fleet, Policy((ECHO_FOR_ALL,), OFFER_ANY))
    fleet.planes.run(1.0)
    assert answered(good, [request]) == 1
    fleet.planes.run(WITHDRAW_AFTER_S)
    assert [event.name for event in good.events if isinstance(event, WithdrawService)] == [SECRET]


def test_a_cloud_restarted_without_a_control_plane_goes_on_refusing() -> None:
    fleet = Fleet(POLICY, rogue=True)
    for cloud in fleet.clouds:
        held = restored(fleet.planes.peer_sets[cloud.name])
        cloud.start()
        assert cloud.engine.apply_peers(held, fleet.mesh.now) is None
        fleet.mesh.pump(cloud)
    fleet.mesh.run(5.0)  # the control plane says nothing any more
    good, rogue = fleet.good, fleet.other
    secret, denied, echo = good.submit(b"1", SECRET), rogue.submit(b"2", SECRET), rogue.submit(b"3")
    fleet.mesh.run(2.0)
    assert answered(good, [secret]) == answered(rogue, [echo]) == 1
    assert answered(rogue, [denied]) == 0
    assert any("forbidden" in reason for reason in failures(rogue, [denied]))


def test_who_hides_from_the_control_plane_does_not_keep_its_old_rights() -> None:
    """A cloud keeps a robot whose lease ran out while a path lives, but not over a change of the policy."""
    fleet = Fleet(POLICY)
    hidden, a = fleet.other, fleet.clouds[0]
    fleet.planes.leave(hidden)
    fleet.planes.run(Settings().lease_s + 2.0)
    assert hidden.name not in {peer.name for peer in fleet.planes.peer_sets[a.name].peers}
    (before,) = fleet.calls(1.0, (hidden, SERVICE))
    assert answered(hidden, before) == 20, "no control plane must not cost a request"
    set_policy(fleet, dataclasses.replace(POLICY, calls=(SECRET_FOR_GOOD,)))
    fleet.planes.run(1.0)
    (after,) = fleet.calls(1.0, (hidden, SERVICE))
    assert answered(hidden, after) == 0
