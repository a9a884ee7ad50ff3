"""The topology as data, the plan made of it, and the words that change a running lab."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from ipaddress import ip_address, ip_network
from typing import TYPE_CHECKING

import pytest
from hypothesis import given
from hypothesis import strategies as st

from lab.commands import Command, parse_command
from lab.drawing import draw
from lab.errors import LabConfigError
from lab.plan import make_plan
from lab.topology import HostSpec, InterfaceSpec, LabConfig, NatSpec, robot, server

if TYPE_CHECKING:
    from collections.abc import Callable

INTERFACES = ("wlan0", "wwan0", "usb0", "eth1")


@pytest.mark.parametrize("interfaces", [1, 2, 4])
@pytest.mark.parametrize(("clouds", "robots"), [(1, 1), (2, 1), (5, 3)])
def test_addresses_are_unique_and_each_link_has_its_own_seed(interfaces: int, clouds: int, robots: int) -> None:
    config = LabConfig.of(interfaces=INTERFACES[:interfaces], clouds=clouds, robots=robots)
    plan = make_plan(config, seed=3)
    addresses = [
        address for machine in plan.addresses.values() for families in machine.values() for address in families.values()
    ]
    assert len(set(addresses)) == len(addresses)
    macs = [end.mac for segment in plan.segments for end in (segment.inner, segment.outer)]
    assert len(set(macs)) == len(macs)
    assert len({link.seed for link in plan.links}) == interfaces * robots == len(plan.links)
    assert len(plan.namespaces) == 1 + robots * (1 + interfaces) + clouds + 1
    names = Counter((end.namespace, end.interface) for s in plan.segments for end in (s.inner, s.outer))
    assert max(names.values()) == 1


def test_gateway_of_every_interface_lies_in_its_network() -> None:
    plan = make_plan(LabConfig.of(robots=2), seed=1)
    for host in ("robot", "robot_2", "cloud_a"):
        for interface, lines in plan.namespaces[host].interface_lines.items():
            gateways = [line.split()[4] for line in lines if line.startswith("route replace default")]
            own = plan.addresses[host][interface]
            assert len(gateways) == 2
            assert ip_address(gateways[0]) in ip_network(f"{own[4]}/24", strict=False)
            assert ip_address(gateways[1]) in ip_network(f"{own[6]}/64", strict=False)


def test_same_configuration_makes_the_same_plan() -> None:
    assert make_plan(LabConfig(), 1).to_json() == make_plan(LabConfig(), 1).to_json()
    assert make_plan(LabConfig(), 1).links[0].seed != make_plan(LabConfig(), 2).links[0].seed


def test_first_interface_is_preferred() -> None:
    lines = make_plan(LabConfig(), 1).namespaces["robot"].interface_lines
    assert any("metric 100" in line for line in lines["wlan0"])
    assert any("metric 200" in line for line in lines["wwan0"])


def test_only_hosts_without_nat_can_be_found_by_name() -> None:
    hosts_file = make_plan(LabConfig(), 1).hosts_file
    assert "198.18.3.2 cloud_a\n" in hosts_file
    assert "robot" not in hosts_file


def test_drawing_names_every_host_and_router() -> None:
    config = LabConfig.of(interfaces=INTERFACES, clouds=3)
    text = draw(config, make_plan(config, 1))
    for word in (*INTERFACES, "robot", "cloud_c", "control", "192.168.4.2", "NAT 198.18.4.2", "internet"):
        assert word in text


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: LabConfig(clouds=()), "clouds"),
        (lambda: LabConfig(clouds=(server("robot"),)), "host names"),
        (lambda: LabConfig.of(clouds=0), "clouds"),
        (lambda: LabConfig.of(interfaces=("a", "b", "c", "d", "e")), "at most 4"),
        (lambda: LabConfig.of(robots=101), "interfaces in all"),
        (lambda: robot(interfaces=()), "at least one"),
        (lambda: robot(interfaces=("wlan0", "wlan0")), "each name once"),
        (lambda: robot(interfaces=("lo",)), "interface name"),
        (lambda: robot(interfaces=("a name too long for Linux",)), "interface name"),
        (lambda: server("no spaces"), "host name"),
        (lambda: HostSpec("h", (InterfaceSpec("e", mtu=100),)), "mtu"),
        (lambda: NatSpec(udp_timeout_s=0), "udp_timeout_s"),
    ],
)
def test_senseless_topology_is_refused(make: Callable[[], object], message: str) -> None:
    with pytest.raises(LabConfigError, match=message):
        make()


@pytest.mark.parametrize(
    ("line", "command"),
    [
        ("wlan0 blackhole", Command("wlan0", verb="blackhole")),
        ("robot_2/wlan0 up", Command("wlan0", host="robot_2", verb="up")),
        (
            "wlan0 delay_ms=20 loss=0.5",
            Command("wlan0", changes=(("delay_ms", 20.0), ("loss", 0.5))),
        ),
        ("wlan0.down:rate_kbps=none", Command("wlan0", direction="down", changes=(("rate_kbps", None),))),
        ("wlan0:queue_bytes=5,loss=1", Command("wlan0", changes=(("queue_bytes", 5), ("loss", 1.0)))),
    ],
)
def test_command_is_understood(line: str, command: Command) -> None:
    assert parse_command(line) == command


@pytest.mark.parametrize(
    "line",
    [
        "",
        "wlan0",
        "wlan0 explode",
        "wlan0.left loss=1",
        "/wlan0 up",
        "wlan0 loss=much",
        "wlan0 loss=2",
        "wlan0.up blackhole",
    ],
)
def test_senseless_command_is_refused(line: str) -> None:
    with pytest.raises(LabConfigError):
        parse_command(line)


@given(st.one_of(st.text(), st.text(st.sampled_from("wlan0.:/,= updoss1e"), max_size=30)))
def test_any_line_is_a_command_or_a_configuration_error(line: str) -> None:
    try:
        command = parse_command(line)
    except LabConfigError:
        return
    assert bool(command.verb) != bool(command.changes)
    assert replace(command) == command
