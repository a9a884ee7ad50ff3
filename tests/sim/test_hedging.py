"""With one interface left, a second server is asked in time when the first one has the request and is silent."""

from __future__ import annotations

from typing import TYPE_CHECKING

from plr.protos.model.ids import InterfaceName
from tests.sim.test_mesh import assert_at_most_once, assert_each_answered_once, call_at, mapped, two_by_two

if TYPE_CHECKING:
    from lab.simulated.mesh import Mesh, Node


def wwan_only(*, deadline_s: float = 0.3) -> tuple[Mesh, Node, Node, Node]:
    """Mapped over both interfaces; wlan0 has no path any more."""
    mesh, robot, one, two = two_by_two(deadline_s=deadline_s)
    mapped(mesh, robot, ("wlan0", "cloud-a"), ("wwan0", "cloud-b"))
    robot.engine.set_interfaces([InterfaceName("wwan0")], mesh.now)
    mesh.pump(robot)
    return mesh, robot, one, two


def test_a_server_that_died_unnoticed_makes_nothing_late_over_the_only_path() -> None:
    mesh, robot, one, two = wwan_only()
    two.server = lambda event: None
    calls = call_at(mesh, robot, 20, 5)
    mesh.run(0.1)
    assert_each_answered_once(robot, calls)
    assert not any(event.late for event in robot.responses())
    assert {event.server for event in robot.responses()} == {one.name}
    assert_at_most_once(one, two)


def test_no_second_server_is_asked_while_the_first_one_answers() -> None:
    mesh, robot, one, two = wwan_only()
    calls = call_at(mesh, robot, 20, 5)
    assert_each_answered_once(robot, calls)
    assert (len(one.executed), len(two.executed)) == (0, calls)


def test_a_path_that_is_slow_does_not_carry_everything_twice() -> None:
    """At half the deadline, after 0.3 s, nobody knows yet whether the request arrived."""
    mesh, robot, one, two = wwan_only(deadline_s=0.6)
    for cloud in ("cloud-a", "cloud-b"):
        mesh.wire("robot.wwan0", f"{cloud}.eth0").delay_s = 0.2
        mesh.wire(f"{cloud}.eth0", "robot.wwan0").delay_s = 0.2
    mesh.run(3.0)
    call_at(mesh, robot, 4, 5, size=10_000)
    mesh.run(0.5)
    assert (len(one.executed), len(two.executed)) == (0, 20)
