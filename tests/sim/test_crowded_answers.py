"""More answers than there is room for: they wait, each robot's apart, and what is never sent is told."""

from __future__ import annotations

import pytest

from lab.simulated.mesh import SERVICE, TYPE, Mesh, Node, rule
from plr.protos.model.ids import Role
from plr.protos.model.members import ServiceOffer
from plr.sidecar.core.cloud import answers as answers_module
from plr.sidecar.core.seam.application import RequestFailed
from plr.sidecar.core.transfer import room as room_module
from plr.sidecar.core.transfer.room import SMALL_BYTES, Lane

pytestmark = pytest.mark.audit("dp-1")
MBIT = 1e6 / 8
SIZE = 400_000
ROOM = 3 * SIZE + 1000
"""What the tests call room: large answers are small here, so that a test takes a second."""


@pytest.fixture
def little_room(monkeypatch: pytest.MonkeyPatch) -> None:
    assert SIZE > SMALL_BYTES
    monkeypatch.setitem(room_module._ROOM_BYTES, Lane.LARGE, ROOM)


def failed(robot: Node) -> list[RequestFailed]:
    return [event for event in robot.events if isinstance(event, RequestFailed)]


def world(size: int = SIZE, *interfaces: str, mbit: float = 20.0, **changes: object) -> tuple[Mesh, Node, Node]:
    """A robot of these interfaces, and a cloud whose answers have `size` bytes unless the request says another."""
    mesh = Mesh(1)
    values: dict[str, object] = {"deadline_s": 5.0, "lifetime_s": 60.0, "idempotent": False, **changes}
    robot = mesh.robot(*(interfaces or ("wlan0",)), rules=(rule(**values),))
    cloud = mesh.cloud("cloud-a")
    cloud.answer = lambda payload: bytes(int(payload[4:] or size))
    cloud.server_delay = lambda: 0.05
    mesh.push_views()
    for interface in robot.interfaces:
        for wire in mesh.both_ways(f"robot.{interface}", "cloud-a.eth0"):
            wire.delay_s, wire.bytes_per_s = 0.02, mbit * MBIT
    mesh.run(1.0)
    return mesh, robot, cloud


def ask(robot: Node, count: int, text: bytes = b"") -> None:
    for number in range(count):
        robot.submit(number.to_bytes(4, "big") + text)


def cut_off(mesh: Mesh, address: str) -> None:
    for wire in mesh.all_wires_of(address):
        wire.cut = True


def assert_nothing_is_left(*nodes: Node) -> None:
    for node in nodes:
        engine = node.engine
        assert (len(engine._outbox), engine._outbox.held_bytes, engine.busy) == (0, 0, 0)
        if node.role is Role.CLOUD:
            answers = engine.cloud.answers
            assert (len(answers), answers.held_bytes, len(answers._lines), len(answers._of)) == (0, 0, 0, 0)
            assert not answers._got


def test_twenty_answers_of_4_mb_all_arrive() -> None:
    mesh, robot, cloud = world(4_000_000, "wlan0", "wwan0", mbit=200.0)
    ask(robot, 20)
    mesh.run(10.0)
    assert len(cloud.executed) == len(robot.responses()) == 20
    mesh.run(20.0)
    assert_nothing_is_left(robot, cloud)


@pytest.mark.usefixtures("little_room")
@pytest.mark.parametrize("idempotent", [True, False])
def test_answers_that_wait_share_both_paths(idempotent: bool) -> None:
    mesh, robot, cloud = world(SIZE, "wlan0", "wwan0", idempotent=idempotent)
    ask(robot, 40)
    mesh.run(60.0)
    assert len(robot.responses()) == len(cloud.executed) == 40
    one_path_s = 40 * SIZE / (20 * MBIT)
    assert max(event.elapsed_s for event in robot.responses()) < 0.85 * one_path_s
    assert_nothing_is_left(robot, cloud)


@pytest.mark.usefixtures("little_room")
def test_small_answers_do_not_wait_for_large_ones_nor_keep_them_out() -> None:
    mesh, robot, _ = world(mbit=5.0)
    ask(robot, 10)
    mesh.run(0.5)
    for _ in range(40):
        ask(robot, 1, b"20000")
        mesh.run(0.2)
    mesh.run(30.0)
    slowest = {size: max(e.elapsed_s for e in robot.responses() if len(e.payload) == size) for size in (20_000, SIZE)}
    assert len(robot.responses()) == 50
    assert slowest[20_000] < 5.0
    assert slowest[SIZE] < 20.0


def test_more_small_answers_than_messages_wait(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(room_module, "MAX_UNDELIVERED_MESSAGES", 200)
    mesh, robot, cloud = world(1000)
    cloud.late_s = lambda: 0.02
    for _ in range(10):
        ask(robot, 90)  # the robot's own room is as little
        mesh.run(0.02)
    mesh.run(20.0)
    assert len(robot.responses()) == 900
    assert_nothing_is_left(robot, cloud)


@pytest.mark.usefixtures("little_room")
def test_what_has_no_room_to_wait_is_told_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(answers_module, "MAX_ANSWER_BYTES", 20 * SIZE)
    mesh, robot, cloud = world()
    ask(robot, 70)
    mesh.run(2.0)
    assert {event.outcome for event in failed(robot)} == {"rejected"}
    assert all("too much data already waits to be sent" in event.reason for event in failed(robot))
    mesh.run(30.0)
    assert len(failed(robot)) == cloud.engine.stats.dropped["answers_full"] == 60
    assert len(robot.responses()) == 10
    assert_nothing_is_left(robot, cloud)


@pytest.mark.usefixtures("little_room")
def test_an_answer_that_waits_until_its_time_is_over_is_told_before() -> None:
    mesh, robot, cloud = world(mbit=1.0, lifetime_s=10.0)
    ask(robot, 12)
    mesh.run(20.0)
    told = [event for event in failed(robot) if "no part of it could be sent" in event.reason]
    assert len(robot.responses()) + len(failed(robot)) == 12
    assert 0 < len(robot.responses()) < 5
    assert len(told) == cloud.engine.stats.dropped["answer_unsent"] > 6
    assert all(9.0 <= event.elapsed_s < 10.0 for event in told)
    assert_nothing_is_left(robot, cloud)


@pytest.mark.usefixtures("little_room")
def test_an_idempotent_request_whose_answer_is_never_sent_is_asked_elsewhere() -> None:
    mesh, robot, _ = world(mbit=1.0, lifetime_s=10.0, idempotent=True, redundancy=rule().redundancy.SINGLE)
    ask(robot, 12)
    mesh.run(8.0)
    other = mesh.add("cloud-b", Role.CLOUD, ["eth0"], (rule(),))
    other.offers = (ServiceOffer(SERVICE, TYPE),)
    other.engine.cloud.set_offers(other.offers)
    mesh.push_views()
    mesh.run(20.0)
    assert len(other.executed) > 6


@pytest.mark.usefixtures("little_room")
def test_a_robot_that_never_acknowledges_holds_up_nobody_else(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(answers_module, "MAX_ANSWER_BYTES", 40 * SIZE)
    mesh, hog, cloud = world()
    other = mesh.add("other", Role.ROBOT, ["wlan0"], hog.rules)
    mesh.push_views()
    mesh.run(1.0)
    ask(hog, 60)
    mesh.at(0.06, lambda: cut_off(mesh, "robot.wlan0"))
    mesh.run(1.0)
    assert cloud.engine.cloud.answers.held_bytes == 20 * SIZE
    ask(other, 10)
    mesh.run(10.0)
    assert len(other.responses()) == 10
    mesh.run(90.0)
    assert_nothing_is_left(cloud, other)


@pytest.mark.usefixtures("little_room")
def test_a_robot_that_restarts_leaves_no_answer_waiting() -> None:
    mesh, robot, cloud = world()
    ask(robot, 20)
    mesh.run(0.2)
    assert cloud.engine.cloud.answers.unsent([robot.name]) > 10
    robot.alive = False
    robot.start()
    mesh.push_views()
    assert_nothing_is_left(cloud)
    mesh.run(1.0)
    ask(robot, 2)
    mesh.run(5.0)
    assert len(robot.responses()) == 2


@pytest.mark.usefixtures("little_room")
def test_a_sidecar_that_drains_stays_for_answers_that_wait() -> None:
    mesh, robot, cloud = world()
    ask(robot, 20)
    mesh.run(0.5)
    cloud.engine.drain()
    assert cloud.engine.busy > 15
    while cloud.engine.busy:
        mesh.run(0.1)
    assert len(robot.responses()) == 20


@pytest.mark.usefixtures("little_room")
def test_an_answer_that_waits_is_called_off_with_its_request() -> None:
    mesh, robot, slow = world(SIZE, "wlan0", "wwan0", mbit=1.0, idempotent=True)
    fast = mesh.cloud("cloud-b")
    fast.server_delay = lambda: 0.8
    mesh.push_views()
    mesh.run(1.0)
    ask(robot, 12)
    mesh.run(0.5)
    assert slow.engine.cloud.answers.unsent([robot.name]) > 0
    mesh.run(10.0)
    assert len(robot.responses()) == 12
    mesh.run(60.0)
    assert_nothing_is_left(robot, slow)


def test_answers_of_a_session_that_is_over_are_not_sent() -> None:
    mesh = Mesh(1)
    robot = mesh.robot("wlan0", rules=(rule(lifetime_s=120.0, deadline_s=5.0),))
    cloud = mesh.cloud("a")
    cloud.answer = lambda _: bytes(1_000_000)
    down = mesh.wire("a.eth0", "robot.wlan0")
    mesh.push_views()
    mesh.run(2)
    down.bytes_per_s = 20 * MBIT
    for number in range(250):
        robot.submit(b"%d" % number)
    mesh.run(3)
    assert cloud.engine.cloud.answers.unsent([robot.name]) > 150
    robot.start()
    mesh.push_views()
    mesh.run(1)
    assert len(cloud.engine._outbox) == 0
    assert len(cloud.engine.cloud.answers) == 0
    assert robot.engine.stats.dropped["answer_to_unknown_request"] == 0
