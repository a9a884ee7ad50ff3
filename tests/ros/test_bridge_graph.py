"""Which services are carried: rules, foreign servers, other sidecars, types that are not installed."""

from __future__ import annotations

import logging
import signal
import sys
from typing import TYPE_CHECKING, Any

import pytest

from plr.protos.model.ids import Role, ServiceName
from plr.sidecar.core.rules.service_rule import ServiceRule
from plr.sidecar.core.seam.application import OfferService
from plr.sidecar.ros.bridge import RosBridge
from plr.sidecar.ros.graph import graph
from tests.ros.loopback import Loopback
from tests.ros.mesh import RULES, no_name, wait_until

if TYPE_CHECKING:
    from tests.ros.mesh import Mesh

pytestmark = pytest.mark.ros

PLAN = ServiceName("/plan")
PLAN_TYPE = "nav_msgs/srv/GetPlan"


@pytest.fixture
def often(monkeypatch: pytest.MonkeyPatch) -> None:
    """Scan the graph often also while it does not change."""
    monkeypatch.setattr("plr.sidecar.ros.graph.scans.IDLE_PERIOD_S", 0.1)


def scanned(node: Any) -> dict[ServiceName, graph.Served]:
    steps = graph.scan(node, no_name, lambda _service: True, 0.0)
    while True:
        try:
            next(steps)
        except StopIteration as end:
            return dict(end.value)


def test_globs_do_not_open_parameters(mesh: Mesh) -> None:
    mesh.start()
    mesh.serve("--plan", "/plan", "--negate", "/negate", "--parameters")
    mesh.wait_carried("/plan", "/negate")
    offers = {offer.name: offer.type for offer in mesh.link.offers}
    assert offers == {"/plan": PLAN_TYPE, "/negate": "std_srvs/srv/SetBool"}


def test_parameters_are_carried_when_named(mesh: Mesh) -> None:
    mesh.use_rules(ServiceRule("/test_server/get_parameters", deadline_s=0.1, lifetime_s=1.0, capacity=3))
    mesh.start()
    mesh.serve("--plan", "/plan", "--parameters")
    mesh.wait_carried("/test_server/get_parameters")
    assert [offer.capacity for offer in mesh.link.offers] == [3]


def test_a_server_whose_qos_does_not_fit_is_told_from_none(mesh: Mesh) -> None:
    mesh.start()
    mesh.serve("--plan", "/plan", "--best-effort")
    mesh.serve("--negate", "/negate")
    mesh.wait_carried("/negate")
    wait_until(lambda: mesh.cloud.stats.mismatched == {PLAN}, "the mismatch is seen")
    assert mesh.cloud.stats.carried == {"/negate"}


def test_a_name_that_is_served_on_the_robot_is_left_alone(mesh: Mesh, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO, "plr.sidecar")
    mesh.start()
    own = mesh.serve("--plan", "/plan", "--node", "own_planner", domain=mesh.robot_domain)
    mesh.serve("--plan", "/plan", "--negate", "/negate")
    mesh.wait_carried("/negate")
    assert mesh.robot.stats.left_alone == {"/plan": ("/own_planner",)}
    assert [r.getMessage() for r in caplog.records if "left alone" in r.getMessage()] == [
        "service /plan is already served by /own_planner on this robot: left alone"
    ]
    assert mesh.result(mesh.call("/plan"))["answered"] == 1
    assert mesh.robot.stats.requests_taken[PLAN] == 0

    own.stop(signal.SIGTERM)
    mesh.wait_carried("/negate", "/plan")
    assert mesh.robot.stats.left_alone == {}
    assert mesh.result(mesh.call("/plan"))["answered"] == 1
    assert mesh.robot.stats.requests_taken[PLAN] == 1


def test_a_server_that_appears_on_the_robot_takes_over(mesh: Mesh) -> None:
    mesh.start()
    mesh.serve("--plan", "/plan")
    mesh.wait_carried("/plan")
    mesh.serve("--plan", "/plan", "--node", "own_planner", domain=mesh.robot_domain)
    mesh.wait_carried()
    assert mesh.robot.stats.left_alone == {"/plan": ("/own_planner",)}
    result = mesh.result(mesh.call("/plan", "--count", "8"))
    assert (result["answered"], result["twice"]) == (8, 0)


@pytest.mark.audit("dp-16")
def test_servers_whose_nodes_share_a_name_are_all_carried(mesh: Mesh, caplog: pytest.LogCaptureFixture) -> None:
    """As when one program is started twice: rmw, asked by node name, shows the services of one of them only."""
    caplog.set_level(logging.WARNING, "plr.sidecar")
    mesh.start()
    mesh.serve("--plan", "/plan")
    mesh.serve("--negate", "/negate")
    mesh.serve("--plan", "/plan_too", "--negate", "/negate_too")
    mesh.wait_carried("/plan", "/negate", "/plan_too", "/negate_too")
    assert {offer.name: offer.type for offer in mesh.link.offers} == {
        "/plan": PLAN_TYPE,
        "/plan_too": PLAN_TYPE,
        "/negate": "std_srvs/srv/SetBool",
        "/negate_too": "std_srvs/srv/SetBool",
    }
    assert [r for r in caplog.records if "servers here" in r.getMessage()] == []


@pytest.mark.audit("dp-16")
def test_two_servers_of_a_service_are_reported_though_their_nodes_share_a_name(
    mesh: Mesh, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.WARNING, "plr.sidecar")
    mesh.start()
    mesh.serve("--plan", "/plan")
    mesh.serve("--plan", "/plan")
    wait_until(lambda: [r for r in caplog.records if "servers here" in r.getMessage()], "the warning")
    assert [r.getMessage() for r in caplog.records if "servers here" in r.getMessage()] == [
        "service /plan has 2 servers here (/test_server): each request runs on all of them, the first answer counts"
    ]


@pytest.mark.usefixtures("often")
def test_two_cloud_sidecars_and_a_robot_in_one_domain(mesh: Mesh) -> None:
    """A robot's proxies are no services to offer, and a real server beside a robot sidecar is left alone."""
    mesh.robot = RosBridge(name="robot-1", role=Role.ROBOT, rules=RULES, domain_id=mesh.cloud_domain)
    mesh.link.robot_app = mesh.robot
    second_cloud = RosBridge(name="cloud-2", role=Role.CLOUD, rules=RULES, domain_id=mesh.cloud_domain)
    second_robot = RosBridge(name="robot-2", role=Role.ROBOT, rules=RULES, domain_id=mesh.robot_domain)
    second_link = Loopback(second_robot, second_cloud)
    mesh.start()
    second_cloud.start(second_link.cloud)
    second_robot.start(second_link.robot)
    try:
        # robot-1 proxies a service of another mesh into the domain of cloud-2, which must not offer it on.
        mesh.robot.handle(OfferService(ServiceName("/elsewhere"), PLAN_TYPE))
        mesh.serve("--plan", "/plan")
        wait_until(lambda: second_link.carried == {"/plan"} and mesh.link.offers, "the real service")
        scans = second_cloud.stats.scans
        wait_until(lambda: second_cloud.stats.scans >= scans + 3, "three scans of the graph")
        assert {offer.name for offer in second_link.offers} == {offer.name for offer in mesh.link.offers} == {"/plan"}
        mesh.wait_carried("/elsewhere")
        assert mesh.robot.stats.left_alone == {"/plan": ("/test_server",)}
    finally:
        assert second_robot.stop()
        assert second_cloud.stop()
        second_link.stop()


@pytest.mark.usefixtures("often")
def test_two_robot_sidecars_in_one_domain_offer_a_name_once(mesh: Mesh) -> None:
    """Two proxies would answer each request twice."""
    other = RosBridge(name="robot-0", role=Role.ROBOT, rules=RULES, domain_id=mesh.robot_domain)
    other_link = Loopback(other, mesh.cloud)
    other.start(other_link.robot)
    mesh.start()
    try:
        for bridge in (mesh.robot, other):
            bridge.handle(OfferService(PLAN, PLAN_TYPE))
        wait_until(lambda: mesh.robot.stats.scans > 8 and other.stats.scans > 8, "scans of the graph")
        wait_until(lambda: len(mesh.link.carried) + len(other_link.carried) == 1, "exactly one proxy")
        scans = mesh.robot.stats.scans
        wait_until(lambda: mesh.robot.stats.scans > scans + 4, "more scans")
        assert len(mesh.link.carried) + len(other_link.carried) == 1
    finally:
        assert other.stop()
        other_link.stop()


@pytest.mark.usefixtures("often")
def test_a_type_that_is_not_installed_on_the_robot(mesh: Mesh, caplog: pytest.LogCaptureFixture) -> None:
    mesh.start()
    for name, kind in {
        "/a": "nowhere_msgs/srv/Thing",
        "/b": "os/path/Join",
        "/c": "nav_msgs/srv/NoSuchService",
        "/d": "../srv/X",
        "not a name": PLAN_TYPE,
        "/good": PLAN_TYPE,
    }.items():
        mesh.robot.handle(OfferService(ServiceName(name), kind))
    mesh.robot.handle(OfferService(ServiceName("/a"), "nowhere_msgs/srv/Thing"))
    mesh.wait_carried("/good")
    wait_until(lambda: mesh.robot.stats.scans > 8, "more scans")
    assert set(mesh.robot.stats.missing_types) == {"/a", "/b", "/c", "/d"}
    assert mesh.robot.stats.errors == {"type_not_installed": 2, "service_refused": 2}
    errors = [record.getMessage() for record in caplog.records if record.levelno >= logging.ERROR]
    assert len([line for line in errors if "nowhere_msgs" in line]) == 1
    assert any("install the ROS package 'nowhere_msgs'" in line for line in errors)


@pytest.mark.usefixtures("often")
def test_a_configured_type_that_is_not_installed_is_named_before_any_server_offers_it(
    mesh: Mesh, caplog: pytest.LogCaptureFixture
) -> None:
    configured = {"/a": "nowhere_msgs/srv/Thing", "/good": PLAN_TYPE, "/maps/*": "nowhere_msgs/srv/Thing"}
    mesh.use_rules(*(ServiceRule(name, deadline_s=0.1, lifetime_s=1.0, type=kind) for name, kind in configured.items()))
    mesh.start()
    wait_until(lambda: mesh.robot.stats.missing_types == {"/a": "nowhere_msgs/srv/Thing"}, "the missing type")
    (line,) = [record.getMessage() for record in caplog.records if record.levelno >= logging.ERROR]
    assert "install the ROS package 'nowhere_msgs'" in line
    mesh.robot.handle(OfferService(ServiceName("/good"), PLAN_TYPE))
    mesh.wait_carried("/good")
    scans = mesh.robot.stats.scans
    wait_until(lambda: mesh.robot.stats.scans > scans + 4, "more scans")
    assert mesh.robot.stats.errors == {"type_not_installed": 1}


def test_a_type_that_is_installed_later(
    mesh: Mesh, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr("plr.sidecar.ros.cloud.cloud_side.TYPE_RETRY_S", 0.3)
    with monkeypatch.context() as without:
        without.delitem(sys.modules, "std_srvs.srv", raising=False)
        without.setitem(sys.modules, "std_srvs", None)  # importing it fails, as when it is not installed
        mesh.start()
        mesh.serve("--plan", "/plan", "--negate", "/negate")
        mesh.wait_carried("/plan")
        wait_until(lambda: mesh.cloud.stats.missing_types == {"/negate": "std_srvs/srv/SetBool"}, "the missing type")
        assert [r for r in caplog.records if "install the ROS package 'std_srvs'" in r.getMessage()]
    mesh.wait_carried("/plan", "/negate")
    assert mesh.cloud.stats.missing_types == {}


def test_hidden_from_node_lists_and_without_services_of_its_own(mesh: Mesh) -> None:
    mesh.start()
    mesh.serve("--plan", "/plan")
    mesh.wait_carried("/plan")
    node = mesh.robot._loop.node  # type: ignore[union-attr]  # a started bridge has one
    assert node.get_name() == "_plr_sidecar_robot_1"
    assert set(scanned(node)) == {"/plan"}
