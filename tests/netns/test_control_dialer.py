"""The control stream over real interfaces: a carrier that goes dark without a word takes it away for a moment only.

The default route leads over either. How long it takes is measured in simulated time
(tests/sim/test_control_dialing.py); here it has to work at all, with the real programs, mutual TLS and real sockets,
while the carrier stays dark.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from lab import Lab, LabConfig, LinkProfile
from lab.system import CONTROL_PORT, STUN_PORT, System
from tests.support.calling import Call, assert_flawless

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path
    from typing import Any

    from lab.system import Part

pytestmark = [pytest.mark.netns, pytest.mark.ros, pytest.mark.timeout(180), pytest.mark.audit("dp-12")]

SERVICE = {"name": "/echo", "deadline_ms": 500, "lifetime_ms": 30_000, "idempotent": True}
REGISTERED = "registered with the control plane"
PATIENCE_S = 40.0


@pytest.fixture(scope="module", params=[("wlan0", "wwan0"), ("wwan0", "wlan0")], ids=" before ".join)
def order(request: pytest.FixtureRequest) -> tuple[str, str]:
    """The robot's interfaces; the first has the default route."""
    names: tuple[str, str] = request.param
    return names


@pytest.fixture(scope="module")
def system(order: tuple[str, str], tmp_path_factory: pytest.TempPathFactory) -> Iterator[System]:
    with Lab(LabConfig.of(interfaces=order, clouds=1), seed=1) as lab:
        running = System(lab, tmp_path_factory.mktemp("dialer"))
        control = lab.host("control")
        running.start_control_plane(
            listen=f"[::]:{CONTROL_PORT}",
            stun_listen=[f"[::]:{STUN_PORT}"],
            stun_servers=[f"{control.address()}:{STUN_PORT}", f"[{control.address(family=6)}]:{STUN_PORT}"],
        )
        running.start_node("cloud_a.echo", "cloud_a", ["-m", "lab.echo", "serve"])
        running.start_cloud("cloud_a", [{"name": "/echo"}])
        yield running
        running.close()


@pytest.fixture(autouse=True)
def good_links(system: System) -> Iterator[None]:
    for name, delay_ms in (("wlan0", 5), ("wwan0", 20)):
        system.lab.link(name).reset()
        system.lab.link(name).set(LinkProfile(delay_ms=delay_ms))
    yield
    robot = system.parts.get("robot.sidecar")
    if robot is not None and robot.process.poll() is None:
        assert robot.terminate() == 0
        assert "Traceback" not in robot.log.read_text()


def address(system: System, family: int) -> str:
    host = system.lab.host("control").address(family=family)
    return f"[{host}]:{CONTROL_PORT}" if family == 6 else f"{host}:{CONTROL_PORT}"


def start(system: System, folder: Path, **changes: Any) -> Part:
    """A robot that remembers nothing."""
    old = system.parts.get("robot.sidecar")
    if old is not None:
        old.log.unlink()
    interfaces = system.lab.host("robot").interfaces
    return system.start_robot([SERVICE], interfaces=interfaces, state_dir=str(folder / "state"), **changes)


def wait_for_line(system: System, robot: Part, *parts: str, times: int = 1) -> None:
    def found() -> bool:
        lines = robot.log.read_text().splitlines()
        return sum(all(part in line for part in parts) for line in lines) >= times

    system.wait(" ".join(parts), found, PATIENCE_S)


@pytest.mark.parametrize("family", [4, 6])
@pytest.mark.parametrize(("dark", "other"), [("wlan0", "wwan0"), ("wwan0", "wlan0")])
def test_a_robot_that_starts_while_a_carrier_is_dark_is_registered_and_mapped(
    system: System, tmp_path: Path, family: int, dark: str, other: str
) -> None:
    system.lab.link(dark).blackhole()
    robot = start(system, tmp_path, control_plane=address(system, family))
    wait_for_line(system, robot, REGISTERED, f"over {other}")
    wait_for_line(system, robot, "/echo goes", f"{other} to cloud-a")
    system.wait_for_offer(robot)


@pytest.mark.parametrize("family", [4, 6])
def test_the_stream_moves_away_from_each_carrier_that_goes_dark(
    system: System, order: tuple[str, str], tmp_path: Path, family: int
) -> None:
    first, second = order
    robot = start(system, tmp_path, control_plane=address(system, family))
    system.wait_for_offer(robot)
    call = Call(system, "--duration", "12", "--rate", "20")
    call.wait_until_sending()
    wait_for_line(system, robot, REGISTERED, f"over {first}")
    system.lab.link(first).blackhole()
    wait_for_line(system, robot, f"lost: nothing arrives over {first}")
    wait_for_line(system, robot, REGISTERED, f"over {second}")
    system.lab.link(first).restore()
    system.wait(f"{first} to be back", lambda: path_up(system, first), PATIENCE_S)
    system.lab.link(second).blackhole()
    wait_for_line(system, robot, REGISTERED, f"over {first}", times=2)
    assert_flawless(call.result())
    moved = system.metrics("robot").get('plr_control_connections_left_total{cause="silent"}')
    assert moved is not None
    assert moved >= 2


def path_up(system: System, interface: str) -> bool:
    return system.metrics("robot").get(f'plr_path_up{{interface="{interface}",peer="cloud-a"}}') == 1


def test_it_goes_back_to_what_is_not_billed(system: System, tmp_path: Path) -> None:
    system.lab.link("wlan0").blackhole()
    networks = [{"interface": "wwan0", "extra_mb_per_day": 100}]
    robot = start(system, tmp_path, networks=networks)
    wait_for_line(system, robot, REGISTERED, "over wwan0")
    system.lab.link("wlan0").restore()
    wait_for_line(system, robot, "opening a new control stream: wlan0 works, and costs less than wwan0")
    wait_for_line(system, robot, REGISTERED, "over wlan0")
    assert "control plane lost" not in robot.log.read_text()


def test_the_next_address_of_the_list_is_taken_where_the_first_is_dead(
    system: System, order: tuple[str, str], tmp_path: Path
) -> None:
    nobody = system.lab.host("cloud_a").address()
    robot = start(system, tmp_path, control_plane=[f"{nobody}:{CONTROL_PORT}", address(system, 6), address(system, 4)])
    wait_for_line(system, robot, REGISTERED, f"plane {address(system, 6)} over {order[0]}")


def test_an_interface_that_is_pulled_takes_the_stream_away_at_once(
    system: System, order: tuple[str, str], tmp_path: Path
) -> None:
    first, second = order
    robot = start(system, tmp_path)
    wait_for_line(system, robot, REGISTERED, f"over {first}")
    system.lab.host("robot").link_down(first)
    wait_for_line(system, robot, REGISTERED, f"over {second}")
    system.lab.host("robot").link_up(first)
    assert f"{first} no longer carries anything" in robot.log.read_text()
