"""Members of the fleet, with good certificates, that do what they may not; and one who is no member any more.

The tests share one system with a policy and run in order.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from lab.system import CONTROL_PORT, System, read_json
from plr.controlplane.ca import Authority
from plr.protos.trust.identity import IdentityRole
from tests.attacks.world import ATTACKER, World, attack_lab, is_ours

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

pytestmark = [pytest.mark.netns, pytest.mark.ros, pytest.mark.timeout(240)]

ROBOT_2 = "robot-2"
"""A robot that may call /plan_path and nothing else."""
POLICY = {
    "calls": [
        {"robots": "robot", "services": "/echo", "clouds": "*"},
        {"robots": ROBOT_2, "services": "/plan_path", "clouds": "*"},
    ],
    "offers": [{"clouds": ["cloud-a", "cloud-b"], "services": ["/echo", "/plan_path"]}],
}
PLAN = {"name": "/plan_path", "deadline_ms": 500, "lifetime_ms": 3_000, "idempotent": True}
GONE_S = 10.0
"""Generous for a busy machine."""


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Iterator[World]:
    """The stage, with a policy and a planner on one cloud."""
    with attack_lab() as lab:
        stage = World(System(lab, tmp_path_factory.mktemp("insiders")))
        try:
            stage.start(POLICY)
            stage.system.start_node("cloud_a.planner", "cloud_a", ["-m", "examples.motion_planning.server"])
            yield stage
            stage.end_calls()
        finally:
            stage.close()


def test_a_cloud_that_offers_what_is_not_its_own(world: World) -> None:
    """Its server answers everything at once, and wrongly; nobody asks it."""
    journal = world.system.folder / "rogue.journal"
    with world.calls():
        world.system.start_node("rogue.echo", ATTACKER, ["-m", "lab.echo", "serve", "--journal", str(journal)])
        rogue = world.system.start_cloud(ATTACKER, [{"name": "/echo"}])
        world.wait_until_counted("plr_offers_refused_total", 1)
        world.system.wait(
            "the rogue to be registered",
            lambda: world.counter(ATTACKER, "plr_control_plane_connected") == 1,
        )
    assert not journal.exists() or journal.read_text() == ""
    assert world.counter("robot", "plr_path_up", peer=ATTACKER) == 0
    assert rogue.terminate() == 0


def test_a_robot_that_calls_what_it_may_not(world: World) -> None:
    """Its sidecar asks cloud-a for /echo over the session that it has for /plan_path."""
    rogue = world.system.start_robot(
        [PLAN], name=ROBOT_2, host="robot_2", interfaces=["eth9"], module="lab.attacker.rogue_sidecar"
    )
    world.system.wait_for_offer(rogue)
    reached = world.counter("cloud_a", "plr_bridge_messages_total", direction="request_to_server", service="/plan_path")
    out = world.system.folder / "rogue.json"
    argv = ["-m", "examples.motion_planning.client", "--rate", "5", "--duration", "4", "--json", str(out)]
    with world.calls():
        client = world.system.start_node("rogue.client", "robot_2", [*argv, "--deadline-ms", "500", "--grace-s", "4"])
        client.process.wait(60.0)
    del world.system.parts["rogue.client"]  # it ended with a complaint, as it should
    asked = read_json(out)["summary"]
    assert asked["sent"] > 0
    assert asked["answered_once"] == 0, "nothing of it was answered"
    assert world.counter("cloud_a", "plr_messages_dropped_total", reason="request_forbidden") >= asked["sent"]
    assert reached == world.counter(
        "cloud_a", "plr_bridge_messages_total", direction="request_to_server", service="/plan_path"
    )


def test_a_robot_that_is_revoked_loses_its_sessions(world: World) -> None:
    """The one of the test before: its paths are up until then, and what it sends afterwards is nobody's."""
    cloud = world.system.parts["cloud_a.sidecar"]
    world.system.wait("its path", lambda: world.counter("cloud_a", "plr_path_up", peer=ROBOT_2) == 1)
    tap = world.tap("cloud_a")
    with world.calls():
        source = next(one.source for one in world.towards(tap, 200) if one.source[0] in addresses(world, "robot_2"))
        before = world.refusals("cloud_a")
        world.revoke(ROBOT_2)
        world.system.wait(
            "the session of the revoked robot to be gone",
            lambda: world.counter("cloud_a", "plr_path_up", peer=ROBOT_2) == 0,
            GONE_S,
        )
        tap.take()
        world.wait_until_refused("cloud_a", before, 1, "unknown_session", "unknown_introducer")
        answers = [one for one in tap.take() if not one.outgoing and one.destination == source and is_ours(one)]
        assert answers == []
    world.wait_until_counted("plr_departures_total", 1, reason="revoked")
    world.wait_until_counted("plr_refused_connections_total", 1, reason="revoked")
    assert cloud.process.poll() is None
    assert world.system.parts[f"{ROBOT_2}.sidecar"].terminate() == 0


def addresses(world: World, robot: str) -> set[str]:
    """Under which the internet knows a robot."""
    router = world.lab.nat(world.lab.host(robot).interfaces[0], host=robot)
    return {router.public_address, world.lab.host(robot).address(family=6)}


@pytest.mark.parametrize("whose", ["another-ca", "robot"])
def test_a_stand_in_for_the_control_plane(world: World, tmp_path: Path, whose: str) -> None:
    """With a certificate of another CA for the right name, or of the right CA for another name."""
    if whose == "robot":
        world.system.authority.write_tls_dir(tmp_path / "tls", f"false-{whose}", IdentityRole.ROBOT)
    else:
        Authority.create().write_tls_dir(tmp_path / "tls", "control", IdentityRole.CONTROL_PLANE)
    argv = ["-m", "lab.attacker.stand_in", str(CONTROL_PORT), str(tmp_path / "tls")]
    stand_in = world.system.start_node(f"stand-in-{whose}", ATTACKER, argv)
    world.system.wait("the stand-in to listen", lambda: "listens" in stand_in.log.read_text())
    target = f"{world.lab.host(ATTACKER).address()}:{CONTROL_PORT}"
    name = f"led-astray-{whose}"
    with world.calls():
        robot = world.system.start_robot([PLAN], name=name, host="robot_2", interfaces=["eth9"], control_plane=target)
        world.system.wait("the sidecar to refuse", lambda: "the sidecar continues without it" in robot.log.read_text())
    assert world.counter("robot_2", "plr_control_plane_connected") == 0
    assert "called" not in stand_in.log.read_text()
    assert robot.terminate() == 0
    stand_in.kill()
