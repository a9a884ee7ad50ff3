"""Real sockets find what a router in the middle takes, although no ICMP tells them."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

import pytest

from bench.dataplane.ours import Ours
from lab import HostSpec, InterfaceSpec, Lab, LabConfig, server
from plr.sidecar.core.path.pmtu import COMMON_MTUS, HEADERS_V4, HEADERS_V6

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

pytestmark = [pytest.mark.netns, pytest.mark.timeout(120)]

NARROW, WIDE = "wlan0", "wwan0"
MTU = 1400
CLOUD = "cloud_a"
NO_ICMP = """
table inet silent {
  chain output {
    type filter hook output priority 0;
    icmp type destination-unreachable drop
    icmpv6 type packet-too-big drop
  }
}
"""
FOUND_WITHIN_S = 30.0


@pytest.fixture(scope="module")
def lab() -> Iterator[Lab]:
    """Behind each interface a NAT router; nobody on the way sends ICMP."""
    interfaces = tuple(InterfaceSpec(name, emulated=False) for name in (NARROW, WIDE))
    config = LabConfig(robots=(HostSpec("robot", interfaces),), clouds=(server(CLOUD),))
    with Lab(config, seed=1) as running:
        for router in (running.host("internet"), *(running.nat(name).router for name in (NARROW, WIDE))):
            assert router.run(["nft", "-f", "-"], input=NO_ICMP).returncode == 0
        yield running


def narrow(lab: Lab, mtu: int) -> None:
    """Between the router of NARROW and the internet, both ways."""
    router = lab.nat(NARROW).router
    network = router.address("wan0", 4).split(".")[2]
    router.ip_batch([f"link set wan0 mtu {mtu}"])
    lab.host("internet").ip_batch([f"link set to{network} mtu {mtu}"])


def longest(ours: Ours) -> dict[str, int]:
    """The longest datagram of each of the robot's paths."""
    links = ours.robot.ask("counters")["links"]
    return {name: link["paths"][CLOUD]["max_datagram"] for name, link in links.items() if CLOUD in link["paths"]}


def wait_until(ours: Ours, mtus: dict[str, int]) -> None:
    """Until each path carries datagrams of the common MTU that fits its network, over either family of addresses."""
    expected = {
        name: {max(common for common in COMMON_MTUS if common <= mtu) - headers for headers in (HEADERS_V4, HEADERS_V6)}
        for name, mtu in mtus.items()
    }
    give_up = time.monotonic() + FOUND_WITHIN_S
    found = longest(ours)
    while not (found.keys() == expected.keys() and all(found[name] in expected[name] for name in expected)):
        assert time.monotonic() < give_up, f"found {found}, expected {expected}"
        time.sleep(0.2)
        found = longest(ours)


def test_two_paths_of_different_mtu_and_one_that_shrinks_under_load(lab: Lab, tmp_path: Path) -> None:
    narrow(lab, MTU)
    both = [(NARROW, CLOUD), (WIDE, CLOUD)]
    with Ours(
        tmp_path,
        robot=lab.host("robot"),
        clouds={CLOUD: lab.host(CLOUD)},
        interfaces=(NARROW, WIDE),
        cloud_interface="eth0",
        mapping=both,
        answer_bytes=20_000,
    ) as ours:
        wait_until(ours, {NARROW: MTU, WIDE: 1500})
        assert None not in ours.call(size=50_000, count=40, rate_hz=20.0).latency_s
        ours.begin(size=50_000, count=80, rate_hz=20.0)
        time.sleep(1.0)
        narrow(lab, 1280)
        assert None not in ours.finish().latency_s
        wait_until(ours, {NARROW: 1280, WIDE: 1500})
