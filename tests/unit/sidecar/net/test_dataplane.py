"""Threads, sockets and engines together over loopback: the real drivers, no namespaces."""

from __future__ import annotations

import random
import socket
import time
from dataclasses import replace
from typing import TYPE_CHECKING

import pytest

from plr.protos.model.ids import InterfaceName, Role, Version
from plr.protos.model.members import MAX_PEERS, PeerSet
from plr.sidecar.core.base.values import PathState, RequestId
from plr.sidecar.core.link.sender import Batch
from plr.sidecar.core.seam.application import CarriedService, OfferService, ResponseArrived
from plr.sidecar.net.interface_thread import BLOCKED_TIMER_S
from tests.support.joined_data_planes import PATIENCE_S, SERVICE, Node, joined, submit

if TYPE_CHECKING:
    from collections.abc import Iterator


@pytest.fixture
def nodes() -> Iterator[tuple[Node, Node]]:
    robot, cloud = Node("robot", Role.ROBOT, 1), Node("cloud", Role.CLOUD, 2)
    with joined(robot, cloud):
        robot.wait_for(OfferService)
        yield robot, cloud


@pytest.mark.parametrize("at_once", [False, True], ids=["by a thread of its own", "from within handle"])
def test_requests_of_all_sizes_are_answered_once_each(nodes: tuple[Node, Node], *, at_once: bool) -> None:
    robot, cloud = nodes
    cloud.answers_at_once = at_once
    payloads = [random.Random(size).randbytes(size) for size in (0, 1, 1000, 5000, 150_000, 2_000_000)]
    for number, payload in enumerate(payloads):
        submit(robot, number, payload)
    answers = robot.wait_for(ResponseArrived, len(payloads))
    got = {event.request_id: event.payload for event in answers if isinstance(event, ResponseArrived)}
    assert [got[RequestId(number.to_bytes(16, "big"))] for number in range(len(payloads))] == [
        b"echo:" + payload for payload in payloads
    ]
    assert len(answers) == len(payloads)


@pytest.mark.audit("ops-14")
def test_each_end_pings_the_other_and_sees_its_paths(nodes: tuple[Node, Node]) -> None:
    for node, other in (nodes, nodes[::-1]):
        (path,) = node.plane.paths_to(other.name)
        for number in range(3):
            node.plane.ping(path, number, 500)
            pong = node.pongs.get(timeout=PATIENCE_S)
            assert (pong.number, pong.path, pong.problem) == (number, path, "")
            assert 0.0 < pong.rtt_s < PATIENCE_S
        ((view, change),) = node.plane.path_views(time.monotonic())
        assert view.id == path
        assert change is not None
        assert change.state is view.state is PathState.UP
        assert not node.thread.link.stats.dropped["unasked_probe_reply"]
    robot = nodes[0]
    robot.plane.ping(path._replace(interface=InterfaceName("wwan9")), 9, 64)
    assert robot.pongs.get(timeout=PATIENCE_S).problem == "there is no such interface"


@pytest.mark.audit("ops-14")
def test_a_peer_that_is_gone_is_reported(nodes: tuple[Node, Node]) -> None:
    robot, cloud = nodes
    cloud.stop()
    deadline = time.monotonic() + PATIENCE_S
    while robot.plane._engine.routes.reaches(cloud.name) and time.monotonic() < deadline:
        time.sleep(0.01)
    robot.plane.apply_peers(PeerSet(Version(2), 2, ()))
    while not (gone := robot.plane.gone_paths(0.0, 8)) and time.monotonic() < deadline:
        time.sleep(0.01)
    ((path, last),) = gone
    assert path.peer == cloud.name
    assert last.reason == "peer closed"
    assert robot.plane.gone_paths(time.monotonic(), 8) == []
    assert [(one.name, one.kept) for one in robot.plane.removed_peers(0.0, 8)] == [(cloud.name, "dormant")]
    assert robot.plane.removed_counts(0.0)[:3] == (0, 1, 0)
    assert robot.plane.heard_dormant(time.monotonic()) == set()


def test_garbage_into_the_socket_is_counted_and_the_rest_is_served(nodes: tuple[Node, Node]) -> None:
    robot, cloud = nodes
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
        for garbage in (b"", b"\x00", b"\xd3", b"\xd2" + bytes(40), b"\xd3" + bytes(1500), bytes(2000)):
            stranger.sendto(garbage, ("127.0.0.1", cloud.thread.port))
    submit(robot, 1, b"still here")
    robot.wait_for(ResponseArrived)
    dropped = cloud.thread.link.stats.dropped
    deadline = time.monotonic() + PATIENCE_S
    while dropped.total() < 6 and time.monotonic() < deadline:
        time.sleep(0.01)
    dropped.pop("unknown_introducer", None)  # the robot, when it was the first to know the other
    assert dropped == {"malformed": 4, "version": 1, "unsealed": 1}


def test_an_internal_error_silences_neither_the_timers_nor_the_interface(
    nodes: tuple[Node, Node], caplog: pytest.LogCaptureFixture
) -> None:
    robot, _ = nodes
    for owner, name in ((robot.plane._engine, "handle_timer"), (robot.thread.link, "handle_timer")):
        fail_once(owner, name)
    robot.plane._timer.arm(0.0)
    submit(robot, 1, b"still here")
    robot.wait_for(ResponseArrived)
    deadline = time.monotonic() + PATIENCE_S
    while len(caplog.records) < 2 and time.monotonic() < deadline:
        time.sleep(0.01)
    assert {record.message.split(";")[-1].strip() for record in caplog.records} == {
        "the timers continue",
        "the interface continues",
    }
    assert robot.plane._timer_thread.is_alive()
    assert robot.thread._thread.is_alive()


def fail_once(owner: object, name: str) -> None:
    real = getattr(owner, name)

    def failing(now: float) -> None:
        setattr(owner, name, real)
        raise RuntimeError("a bug")

    setattr(owner, name, failing)


def test_timers_do_not_spin_while_the_socket_takes_nothing() -> None:
    node = Node("robot", Role.ROBOT, 1)
    thread = node.thread
    overdue = 1.0
    thread.link.next_timer = lambda: 0.0  # type: ignore[method-assign]
    thread._clock = lambda: overdue
    assert thread._due() < overdue
    thread._unsent.append(Batch(("127.0.0.1", 9), b"x", 1))
    assert thread._due() == overdue + BLOCKED_TIMER_S
    thread._socket.close()


def test_a_service_that_is_carried_is_told_as_used_when_it_is_offered() -> None:
    """Its fallback brought the proxy up: the bridge has nothing to say when the first server comes."""
    robot, cloud = Node("robot", Role.ROBOT, 1), Node("cloud", Role.CLOUD, 2)
    robot.plane.set_carried(frozenset({CarriedService(SERVICE, fallback_up=True)}))
    assert robot.uses_told == [()]
    with joined(robot, cloud):
        robot.wait_for(OfferService)
        end = time.monotonic() + PATIENCE_S
        while not robot.uses_told[-1]:
            assert time.monotonic() < end
            time.sleep(0.001)
        (use,) = robot.uses_told[-1]
        assert (use.name, use.fallback_up) == (SERVICE, True)


def test_tells_when_interfaces_or_peers_are_others(nodes: tuple[Node, Node], monkeypatch: pytest.MonkeyPatch) -> None:
    robot, cloud = nodes

    def told() -> bool:
        before, robot.reach_changes = robot.reach_changes, 0
        return before > 0

    told()
    robot.plane.set_links({InterfaceName("lo"): robot.thread})
    assert told()
    robot.plane.apply_peers(PeerSet(Version(2), 1, (cloud.told_to(robot),)))
    assert told()
    robot.plane.apply_peers(PeerSet(Version(3), 1, (cloud.told_to(robot),) * (MAX_PEERS + 1)))
    assert not told(), "refused"
    robot.plane.peer_trust.trust_changed()
    assert told()
    for hangs in (True, False):
        monkeypatch.setattr(robot.thread, "in_turn_for", lambda now, hangs=hangs: 1.0 if hangs else 0.0)
        end = time.monotonic() + PATIENCE_S
        while not told():
            assert time.monotonic() < end
            time.sleep(0.01)


def test_requests_go_on_while_the_credential_is_signed_again(nodes: tuple[Node, Node]) -> None:
    robot, cloud = nodes
    for number in range(10):
        for node in (robot, cloud):
            renewed = replace(node.own.credential, certificate=bytes([number]), signature=b"again")
            node.plane.renew_credential(renewed)
        robot.plane.apply_peers(PeerSet(Version(number + 2), 1, (cloud.told_to(robot),)))
        submit(robot, number, b"still here")
    assert len(robot.wait_for(ResponseArrived, 10)) == 10
    assert "unauthentic" not in cloud.thread.link.stats.dropped
