"""Whole sidecars in simulated time: no request is lost, none is answered twice, at most one run on each server."""

from __future__ import annotations

import dataclasses
from collections import Counter

import pytest

from lab.simulated.mesh import SERVICE, Mesh, Node, rule
from plr.protos.model.ids import InterfaceName, NodeName, Version
from plr.protos.model.mapping import Assignment, MappingSet, ServiceMapping
from plr.protos.model.members import Peer, PeerSet
from plr.sidecar.core.path.path import DOWN_FLOOR_S
from plr.sidecar.core.path.probing import FIRST_PROBE_S
from plr.sidecar.core.seam.application import DeadlineMissed, OfferService, RequestFailed, WithdrawService


def two_by_two(seed: int = 1, **rule_changes: object) -> tuple[Mesh, Node, Node, Node]:
    mesh = Mesh(seed)
    robot = mesh.robot("wlan0", "wwan0", rules=(rule(**rule_changes),))
    one, two = mesh.cloud("cloud-a"), mesh.cloud("cloud-b")
    mesh.push_views()
    mesh.run(1.0)
    return mesh, robot, one, two


def mapped(mesh: Mesh, robot: Node, *pairs: tuple[str, str]) -> None:
    assignments = tuple(Assignment(InterfaceName(interface), NodeName(server)) for interface, server in pairs)
    error = mesh.push_mapping(robot, MappingSet(Version(7), 1, (ServiceMapping(SERVICE, assignments),)))
    assert error is None


def call_at(mesh: Mesh, robot: Node, rate_hz: float, seconds: float, size: int = 1000) -> int:
    calls = int(rate_hz * seconds)
    for _ in range(calls):
        mesh.calls += 1
        robot.submit(mesh.calls.to_bytes(4, "big") + bytes(size))
        mesh.run(1 / rate_hz)
    mesh.run(0.1)  # the last answers
    return calls


def assert_each_answered_once(robot: Node, calls: int) -> None:
    answers = Counter(event.request_id for event in robot.responses())
    assert sum(answers.values()) == calls
    assert set(answers.values()) == {1}
    assert all(event.payload[:5] == b"echo:" for event in robot.responses())


def assert_at_most_once(*clouds: Node) -> None:
    for cloud in clouds:
        assert max(Counter(cloud.executed).values(), default=1) == 1


def test_a_service_appears_with_its_first_live_server_and_goes_with_the_last() -> None:
    mesh, robot, one, two = two_by_two()
    offers = [event for event in robot.events if isinstance(event, OfferService)]
    assert [event.name for event in offers] == [SERVICE]
    for cloud in (one, two):
        assert not [event for event in robot.events if isinstance(event, WithdrawService)]
        cloud.alive = False
        mesh.push_views()
        mesh.run(30.0)
    assert [event.name for event in robot.events if isinstance(event, WithdrawService)] == [SERVICE]


def test_replicates_over_both_interfaces_to_both_servers() -> None:
    mesh, robot, one, two = two_by_two()
    mapped(mesh, robot, ("wlan0", "cloud-a"), ("wwan0", "cloud-b"))
    calls = call_at(mesh, robot, 50, 2)
    assert_each_answered_once(robot, calls)
    assert len(one.executed) == len(two.executed) == calls
    assert_at_most_once(one, two)
    assert robot.engine.stats.duplicate_responses == calls, "both were on their way when the first came"


def test_not_idempotent_runs_on_one_server_only() -> None:
    mesh, robot, one, two = two_by_two(idempotent=False)
    calls = call_at(mesh, robot, 50, 2)
    assert_each_answered_once(robot, calls)
    assert len(one.executed) + len(two.executed) == calls
    assert_at_most_once(one, two)


@pytest.mark.parametrize("seed", range(20))
def test_nothing_is_lost_or_doubled_on_bad_wires(seed: int) -> None:
    mesh, robot, one, two = two_by_two(seed)
    for wire in mesh.wires.values():
        wire.loss = mesh.rng.uniform(0, 0.2)
        wire.duplicate = mesh.rng.uniform(0, 0.2)
        wire.jitter_s = mesh.rng.choice([0.0, 0.005, 0.05])
    calls = call_at(mesh, robot, 20, 2, size=mesh.rng.choice([10, 1500, 30_000]))
    mesh.run(9.0)
    assert_each_answered_once(robot, calls)
    assert_at_most_once(one, two)


@pytest.mark.parametrize("idempotent", [True, False])
def test_a_silent_blackhole_costs_no_request(idempotent: bool) -> None:
    mesh, robot, one, two = two_by_two(idempotent=idempotent)
    mapped(mesh, robot, ("wlan0", "cloud-a"), ("wwan0", "cloud-a" if not idempotent else "cloud-b"))
    before = call_at(mesh, robot, 50, 1)
    for wire in mesh.all_wires_of("robot.wlan0"):
        wire.cut = True
    calls = before + call_at(mesh, robot, 50, 4)
    mesh.run(1.0)
    assert_each_answered_once(robot, calls)
    assert_at_most_once(one, two)
    if idempotent:
        assert max(event.elapsed_s for event in robot.responses()) < 0.03


@pytest.mark.parametrize("seed", range(5))
def test_one_interface_only_survives_a_server_killed_mid_stream(seed: int) -> None:
    mesh = Mesh(seed)
    robot = mesh.robot("wwan0")
    one, two = mesh.cloud("cloud-a"), mesh.cloud("cloud-b")
    mesh.push_views()
    mesh.run(1.0)
    mapped(mesh, robot, ("wwan0", "cloud-a"))
    calls = call_at(mesh, robot, 50, 1)
    one.alive = False
    calls += call_at(mesh, robot, 50, 2)
    mesh.run(2.0)
    assert_each_answered_once(robot, calls)
    assert_at_most_once(one, two)


def test_carrier_and_the_other_server_dead_at_once() -> None:
    mesh, robot, _, two = two_by_two()
    mapped(mesh, robot, ("wlan0", "cloud-a"), ("wwan0", "cloud-b"))
    calls = call_at(mesh, robot, 50, 1)
    for wire in mesh.all_wires_of("robot.wlan0"):
        wire.cut = True
    two.alive = False
    calls += call_at(mesh, robot, 50, 3)
    mesh.run(2.0)
    assert_each_answered_once(robot, calls)


def test_both_links_dark_for_a_while_and_the_requests_wait() -> None:
    mesh, robot, one, two = two_by_two()
    calls = call_at(mesh, robot, 20, 1)
    wires = mesh.all_wires_of("robot.wlan0") + mesh.all_wires_of("robot.wwan0")
    for wire in wires:
        wire.cut = True
    calls += call_at(mesh, robot, 20, 3)
    for wire in wires:
        wire.cut = False
    mesh.run(6.0)
    assert_each_answered_once(robot, calls)
    assert_at_most_once(one, two)
    assert not [event for event in robot.events if isinstance(event, WithdrawService)]
    missed = {event.request_id for event in robot.events if isinstance(event, DeadlineMissed)}
    assert {event.request_id for event in robot.responses() if event.late} <= missed
    assert len(missed) >= 55


def test_a_deadline_is_reported_once_and_the_late_answer_delivered() -> None:
    mesh, robot, one, two = two_by_two()
    one.server_delay = two.server_delay = lambda: 0.5
    robot.submit(b"slow")
    mesh.run(1.0)
    missed = [event for event in robot.events if isinstance(event, DeadlineMissed)]
    (response,) = robot.responses()
    assert len(missed) == 1
    assert response.late
    assert robot.engine.stats.requests[SERVICE, "deadline_missed"] == 1


def test_drop_late_does_not_deliver() -> None:
    mesh, robot, one, two = two_by_two(drop_late=True)
    one.server_delay = two.server_delay = lambda: 0.5
    robot.submit(b"slow")
    mesh.run(1.0)
    assert not robot.responses()
    (failed,) = [event for event in robot.events if isinstance(event, RequestFailed)]
    assert failed.outcome == "late_dropped"


def test_a_server_that_never_answers_costs_only_its_request() -> None:
    mesh, robot, one, two = two_by_two()
    one.server_delay = two.server_delay = lambda: None
    lost = robot.submit(b"never")
    mesh.run(0.01)
    one.server_delay = two.server_delay = lambda: 0.001
    calls = call_at(mesh, robot, 50, 1)
    mesh.run(15.0)
    assert len(robot.responses()) == calls
    (failed,) = [event for event in robot.events if isinstance(event, RequestFailed)]
    assert (failed.request_id, failed.outcome) == (lost, "failed")


def test_a_slow_server_beside_a_fast_one() -> None:
    mesh, robot, one, _ = two_by_two()
    mapped(mesh, robot, ("wlan0", "cloud-a"), ("wwan0", "cloud-b"))
    one.server_delay = lambda: 2.0
    calls = call_at(mesh, robot, 20, 3)
    mesh.run(5.0)
    assert_each_answered_once(robot, calls)
    assert max(event.elapsed_s for event in robot.responses()) < 0.05
    stats = robot.engine.stats
    assert 0 < stats.duplicate_responses < calls / 3, "only full races wait for the slow one"
    assert stats.duplicate_responses + stats.called_off[InterfaceName("wlan0"), NodeName("cloud-a"), SERVICE] == calls


def test_hundreds_in_flight_come_back_in_any_order() -> None:
    mesh, robot, one, two = two_by_two(deadline_s=5.0)
    one.server_delay = two.server_delay = lambda: mesh.rng.uniform(0.001, 1.0)
    sent = {robot.submit(number.to_bytes(4, "big")): number for number in range(500)}
    mesh.run(5.0)
    answers = {event.request_id: event.payload for event in robot.responses()}
    assert answers == {request: b"echo:" + number.to_bytes(4, "big") for request, number in sent.items()}


def test_a_16_mib_message_arrives_and_a_larger_one_is_refused() -> None:
    mesh, robot, *_ = two_by_two(deadline_s=20.0, lifetime_s=60.0)
    for wire in mesh.wires.values():
        wire.delay_s = 0.001
    robot.submit(bytes(16 * 1024 * 1024 - 5))
    mesh.run(20.0)
    assert len(robot.responses()) == 1
    robot.submit(bytes(16 * 1024 * 1024 + 1))
    mesh.run(0.1)
    (failed,) = [event for event in robot.events if isinstance(event, RequestFailed)]
    assert failed.outcome == "rejected"
    assert "limit" in failed.reason


def test_a_restarted_robot_and_a_restarted_cloud_are_known_again_without_a_control_plane() -> None:
    mesh, robot, one, two = two_by_two()
    calls = call_at(mesh, robot, 20, 1)
    held = one.engine.peers.all(), robot.engine.peers.all()
    one.alive = False
    mesh.run(0.5)
    one.start()
    _restore(mesh, one, held[0])
    mesh.run(2.0)
    calls += call_at(mesh, robot, 20, 1)
    assert_each_answered_once(robot, calls)
    assert len(one.executed) == 20
    robot.alive = False
    mesh.run(0.5)
    robot.events.clear()
    robot.start()
    _restore(mesh, robot, held[1])
    mesh.run(2.0)
    calls = call_at(mesh, robot, 20, 1)
    assert_each_answered_once(robot, calls)
    assert_at_most_once(one, two)


def test_a_restarted_cloud_is_known_again_by_a_robot_that_it_knows_no_address_of() -> None:
    """Without a control plane, and with the robot behind a NAT that gives it another address towards each cloud."""
    mesh, robot, one, _ = two_by_two()
    nowhere = [dataclasses.replace(peer, candidates=()) for peer in one.engine.peers.all()]
    one.start()
    _restore(mesh, one, nowhere)
    mesh.run(5.0)
    assert robot.engine.routes.reaches(one.name)
    calls = call_at(mesh, robot, 20, 1)
    assert_each_answered_once(robot, calls)
    assert one.executed


def _restore(mesh: Mesh, node: Node, peers: list[Peer]) -> None:
    """What a sidecar does with its disk copy."""
    assert node.engine.apply_peers(PeerSet(Version(1), 1, tuple(peers)), mesh.now) is None
    mesh.pump(node)


def test_a_control_plane_that_forgets_everybody_costs_nothing() -> None:
    mesh, robot, one, two = two_by_two()
    calls = call_at(mesh, robot, 20, 1)
    one.alive = two.alive = False
    mesh.push_views()  # an empty view, as after a restart of the control plane
    one.alive = two.alive = True
    calls += call_at(mesh, robot, 20, 2)
    assert_each_answered_once(robot, calls)


def test_a_mapping_that_names_the_unknown_is_refused_and_the_old_one_stays() -> None:
    mesh, robot, *_ = two_by_two()
    mapped(mesh, robot, ("wlan0", "cloud-a"))
    for interface, server in (("eth9", "cloud-a"), ("wlan0", "nobody")):
        bad = ServiceMapping(SERVICE, (Assignment(InterfaceName(interface), NodeName(server)),))
        error = mesh.push_mapping(robot, MappingSet(Version(8), 2, (bad,)))
        assert error is not None
        assert interface in error or server in error
    assert robot.engine.robot.mapping.version == 7


@pytest.mark.parametrize("seed", range(15))
def test_random_disasters(seed: int) -> None:
    """Wires cut and healed, a server's machine dead for a while, queues: every request is answered once."""
    mesh, robot, one, two = two_by_two(seed + 100, lifetime_s=30.0)
    calls = 0
    for _ in range(12):
        for interface in ("robot.wlan0", "robot.wwan0"):
            cut = mesh.rng.random() < 0.3
            for wire in mesh.all_wires_of(interface):
                wire.cut = cut
                wire.loss = mesh.rng.choice([0.0, 0.02, 0.1])
        calls += call_at(mesh, robot, 10, mesh.rng.uniform(0.2, 2.0), size=mesh.rng.choice([10, 20_000]))
    for wire in mesh.wires.values():
        wire.cut, wire.loss = False, 0.0
    mesh.run(12.0)
    assert_each_answered_once(robot, calls)
    assert_at_most_once(one, two)
    assert robot.engine.busy == 0


@pytest.mark.parametrize("seed", range(8))
def test_the_first_request_after_an_outage_finds_the_path_itself(seed: int) -> None:
    mesh, robot, *_ = two_by_two(seed)
    wires = [wire for name in ("wlan0", "wwan0") for wire in mesh.all_wires_of(f"robot.{name}")]
    for wire in wires:
        wire.cut = True
    mesh.run(12.0 + 0.03 * seed)
    for wire in wires:
        wire.cut = False
    robot.submit(bytes(1000))
    mesh.run(FIRST_PROBE_S + 6 * mesh.wire("robot.wlan0", "cloud-a.eth0").delay_s)
    assert len(robot.responses()) == 1


def test_over_the_only_interface_another_server_is_asked_once_the_path_to_the_first_is_silent() -> None:
    mesh = Mesh(seed=1)
    robot, dead = mesh.robot("wlan0", rules=(rule(deadline_s=1.0),)), mesh.cloud("a")
    mesh.cloud("b")
    mesh.push_views()
    mesh.run(1.0)
    mapped(mesh, robot, ("wlan0", "a"))
    call_at(mesh, robot, 10.0, 2.0)
    dead.alive = False
    for number in range(5):
        robot.submit(number.to_bytes(4, "big") + bytes(20_000))
        mesh.run(0.02)
    mesh.run(2.0)
    late = robot.responses()[-5:]
    assert {response.server for response in late} == {"b"}
    assert all(response.elapsed_s < DOWN_FLOOR_S for response in late), "before the path counts as down"
