"""16 MB both ways over a single carrier, while something changes in the middle: it arrives, once, and hardly later."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

import pytest

from bench.dataplane.ours import SERVICE, Ours
from lab import HostSpec, InterfaceSpec, Lab, LabConfig, LinkProfile, server

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

pytestmark = [pytest.mark.netns, pytest.mark.timeout(120), pytest.mark.audit("dp-16")]

CARRIER, CLOUD = "wlan0", "cloud_a"
BYTES = 16_000_000
LINK = LinkProfile(delay_ms=10, rate_kbps=60_000)
"""2.2 s each way."""
INTO_IT_S = (1.0, 3.4)
"""Seconds after it was sent: in the middle of the request, and in the middle of the answer."""
PATIENT = {**SERVICE, "deadline_ms": 20_000.0, "lifetime_ms": 60_000.0}
NO_ICMP = """
table inet silent {
  chain output {
    type filter hook output priority 0;
    icmp type destination-unreachable drop
    icmpv6 type packet-too-big drop
  }
}
"""


@pytest.fixture
def lab() -> Iterator[Lab]:
    """One carrier behind a NAT router; nobody on the way sends ICMP."""
    carrier = InterfaceSpec(CARRIER, up=LINK, down=LINK)
    with Lab(LabConfig(robots=(HostSpec("robot", (carrier,)),), clouds=(server(CLOUD),)), seed=1) as running:
        for router in (running.host("internet"), running.nat(CARRIER).router):
            assert router.run(["nft", "-f", "-"], input=NO_ICMP).returncode == 0
        yield running


def rebind(lab: Lab) -> None:
    lab.nat(CARRIER).rebind()


def shrink(lab: Lab) -> None:
    """The way through the router takes shorter packets, both ways."""
    router = lab.nat(CARRIER).router
    network = router.address("wan0", 4).split(".")[2]
    router.ip_batch(["link set wan0 mtu 1300"])
    lab.host("internet").ip_batch([f"link set to{network} mtu 1300"])


@pytest.mark.parametrize("trouble", [rebind, shrink])
def test_16_mb_both_ways_while_the_network_changes(lab: Lab, tmp_path: Path, trouble: Callable[[Lab], None]) -> None:
    with Ours(
        tmp_path,
        robot=lab.host("robot"),
        clouds={CLOUD: lab.host(CLOUD)},
        interfaces=(CARRIER,),
        cloud_interface="eth0",
        mapping=[(CARRIER, CLOUD)],
        service=PATIENT,
        answer_bytes=BYTES,
    ) as ours:
        ours.call(size=100_000, count=20, rate_hz=20.0)
        undisturbed = ours.call(size=BYTES, count=1, grace_s=60.0).latency_s[0]
        ours.begin(size=BYTES, count=1, grace_s=60.0)
        begun = time.monotonic()
        for moment in INTO_IT_S:
            time.sleep(max(0.0, begun + moment - time.monotonic()))
            trouble(lab)
        disturbed = ours.finish().latency_s[0]
        assert ours.robot.ask("counters")["in_flight"] == 0
        assert len(ours.take_one_way()) == 22  # each ran once
    assert undisturbed is not None
    assert disturbed is not None
    assert disturbed < 2 * undisturbed + 2.0
