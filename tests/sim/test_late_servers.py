"""A request outlives a time without any server: whoever offers its service next gets it."""

from __future__ import annotations

import pytest

from lab.simulated.mesh import SERVICE, TYPE, Mesh, Node, rule
from plr.protos.model.members import ServiceOffer
from plr.protos.model.redundancy_mode import RedundancyMode
from plr.sidecar.core.base.values import RejectReason
from plr.sidecar.core.robot.request.service_catalog import WITHDRAW_AFTER_S
from plr.sidecar.core.seam.application import ApplicationEvent, ExecuteRequest, RequestFailed, WithdrawService
from tests.sim.test_mesh import call_at, mapped

SERVERLESS_S = 3.0


def offer_later(mesh: Mesh, node: Node) -> None:
    """Its server has started: the control plane tells everyone."""
    node.offers = (ServiceOffer(SERVICE, TYPE),)
    node.engine.cloud.set_offers(node.offers)
    mesh.push_views()


CALLS = [
    (mode, idempotent) for mode in RedundancyMode for idempotent in (True, False) if idempotent or not mode.sends_late
]
"""Modes that ask several servers one after the other are refused beside a service that is not idempotent."""


@pytest.mark.parametrize(("mode", "idempotent"), CALLS)
@pytest.mark.parametrize("known_dead", [True, False])
def test_requests_of_a_time_without_servers_are_answered_by_the_first_that_comes(
    mode: RedundancyMode, idempotent: bool, known_dead: bool
) -> None:
    """The only cloud with a server dies while the other one still waits for its server to start."""
    mesh = Mesh(1)
    robot = mesh.robot("wlan0", "wwan0", rules=(rule(idempotent=idempotent, redundancy=mode),))
    starting, dying = mesh.cloud("cloud-a"), mesh.cloud("cloud-b")
    starting.offers = ()
    starting.engine.cloud.set_offers(())
    mesh.push_views()
    mesh.run(1.0)
    mapped(mesh, robot, ("wlan0", "cloud-b"), ("wwan0", "cloud-b"))
    call_at(mesh, robot, 20, 1.0)
    assert len(robot.responses()) == 20
    dying.alive = False
    if known_dead:  # no path to it is up any more
        mesh.run(2.0)
    waiting = call_at(mesh, robot, 20, SERVERLESS_S)
    offer_later(mesh, starting)
    mesh.run(0.5)
    lost = 0 if known_dead or idempotent else 20  # what the dead one may have run, nobody else may run
    assert len(robot.responses()) >= 20 + waiting - lost
    assert len({answer.request_id for answer in robot.responses()}) == len(robot.responses())


@pytest.mark.parametrize("mode", RedundancyMode)
@pytest.mark.parametrize("successor", ["another", "the same again"])
def test_what_the_only_server_had_when_its_process_ended_runs_on_the_next_one(
    mode: RedundancyMode, successor: str
) -> None:
    """The cloud's sidecar lives and says so: it may have run, which does no harm to what is idempotent."""
    mesh = Mesh(1)
    robot = mesh.robot("wlan0", "wwan0", rules=(rule(redundancy=mode, lifetime_s=30.0),))
    starting, dying = mesh.cloud("cloud-a"), mesh.cloud("cloud-b")
    starting.offers = ()
    starting.engine.cloud.set_offers(())
    mesh.push_views()
    mesh.run(1.0)
    mapped(mesh, robot, ("wlan0", "cloud-b"), ("wwan0", "cloud-b"))

    def lose(event: ApplicationEvent) -> None:
        if isinstance(event, ExecuteRequest):
            dying.engine.cloud.refuse(event.execution, RejectReason.SERVER_LOST, "the server's process ended", mesh.now)

    dying.server = lose
    asked = call_at(mesh, robot, 20, 0.2)
    mesh.run(1.0)
    assert not [event for event in robot.events if isinstance(event, RequestFailed)]
    if successor == "another":
        offer_later(mesh, starting)
    else:
        dying.alive = False
        mesh.push_views()
        mesh.run(5.0)
        dying.server = None
        dying.start()
        mesh.push_views()
    mesh.run(3.0)
    assert len(robot.responses()) == asked


def test_the_restart_of_the_only_cloud_costs_no_request() -> None:
    mesh = Mesh(1)
    robot = mesh.robot("wlan0", "wwan0", rules=(rule(lifetime_s=30.0),))
    cloud = mesh.cloud("cloud-a")
    mesh.push_views()
    mesh.run(1.0)
    asked = call_at(mesh, robot, 20, 1.0)
    cloud.alive = False
    asked += call_at(mesh, robot, 20, 1.0)
    mesh.push_views()
    asked += call_at(mesh, robot, 20, WITHDRAW_AFTER_S / 2)
    cloud.start()
    mesh.push_views()
    asked += call_at(mesh, robot, 20, 2.0)
    assert len(robot.responses()) == asked
    assert not [event for event in robot.events if isinstance(event, WithdrawService)]


def test_what_waits_when_a_long_tunnel_begins_has_its_whole_lifetime() -> None:
    mesh = Mesh(1)
    robot = mesh.robot("wlan0", "wwan0", rules=(rule(lifetime_s=30.0),))
    cloud = mesh.cloud("cloud-a")
    mesh.push_views()
    mesh.run(1.0)
    cloud.alive = False
    asked = call_at(mesh, robot, 5, 1.0)
    mesh.run(WITHDRAW_AFTER_S + 8.0)
    cloud.start()
    mesh.push_views()
    mesh.run(2.0)
    assert len(robot.responses()) == asked


@pytest.mark.parametrize("mode", RedundancyMode)
def test_what_waits_at_a_withdrawn_service_fails_with_it_and_once(mode: RedundancyMode) -> None:
    mesh = Mesh(1)
    robot = mesh.robot("wlan0", "wwan0", rules=(rule(redundancy=mode),))
    cloud = mesh.cloud("cloud-a")
    mesh.push_views()
    mesh.run(1.0)
    answered = call_at(mesh, robot, 5, 1.0)
    cloud.alive = False
    asked = call_at(mesh, robot, 40, WITHDRAW_AFTER_S + 3.0)
    withdrawn = next(n for n, event in enumerate(robot.events) if isinstance(event, WithdrawService))
    failed = [n for n, event in enumerate(robot.events) if isinstance(event, RequestFailed)]
    at_once = [event for event in robot.events if isinstance(event, RequestFailed) and "withdrawn" in event.reason]
    assert len(at_once) >= 5
    assert [n for n in failed if n < withdrawn][-len(at_once) :] == list(range(withdrawn - len(at_once), withdrawn))
    mesh.run(30.0)
    ended = [event.request_id for event in robot.events if isinstance(event, RequestFailed)]
    assert len(robot.responses()) == answered
    assert len(ended) == len(set(ended)) == asked


@pytest.mark.audit("dp-16")
@pytest.mark.parametrize("idempotent", [True, False])
@pytest.mark.parametrize("mode", RedundancyMode)
def test_a_server_that_is_not_there_yet_is_asked_again(mode: RedundancyMode, idempotent: bool) -> None:
    """Its sidecar is up before its ROS side is, and nobody says when that changes."""
    mesh = Mesh(1)
    robot = mesh.robot("wlan0", "wwan0", rules=(rule(redundancy=mode, idempotent=idempotent, lifetime_s=30.0),))
    cloud = mesh.cloud("cloud-a")
    mesh.push_views()
    mesh.run(1.0)
    cloud.engine.cloud.set_offers(())
    mesh.at(1.5, lambda: cloud.engine.cloud.set_offers(cloud.offers))
    asked = call_at(mesh, robot, 40, 3.0)
    mesh.run(5.0)
    assert [event for event in robot.events if isinstance(event, RequestFailed)] == []
    assert len(robot.responses()) == asked
    assert len(cloud.executed) == asked, "none ran twice"
