"""A fuzzer at the ports of running sidecars: nothing crashes, nothing grows, nothing reaches ROS.

`--fuzz-datagrams 1000000` (make fuzz) is the long version: so many at each victim, 20,000 a second.
"""

from __future__ import annotations

import base64
from typing import TYPE_CHECKING, Any

import pytest

from bench.dataplane.remote import Remote
from tests.attacks.world import ATTACKER, World

if TYPE_CHECKING:
    from pathlib import Path

pytestmark = [pytest.mark.netns, pytest.mark.busy, pytest.mark.ros, pytest.mark.timeout(3600)]

RATE_HZ = 20_000.0
SEEN = 200
MB = 1e6
GROWTH_BYTES = 32 * MB
LOG_LINES = 40
"""A sidecar may say something of what comes, but not as often as it comes."""
STARTING_HOST = {"cloud_a": ATTACKER, "robot": "robot-wlan0-nat"}
"""Where the fuzzer sits: the robot's NAT lets nothing in, so it is in the same wireless network."""


@pytest.mark.parametrize("victim", STARTING_HOST)
def test_a_fuzzer_at_the_port(world: World, tmp_path: Path, victim: str, fuzz_datagrams: int) -> None:
    tap = world.tap(victim)
    with world.calls():
        seen = world.towards(tap, SEEN)
    world.end_calls()
    sidecar = world.system.parts[f"{victim}.sidecar"]
    real = [base64.b64encode(one.payload).decode() for one in seen]
    address, port = seen[0].destination
    with Remote.start("flood", tmp_path, host=world.lab.host(STARTING_HOST[victim])) as fuzzer:
        plan: dict[str, Any] = {"address": address, "port": port, "seen": real, "rate_hz": RATE_HZ}
        fuzzer.ask("fuzz", **plan, count=min(fuzz_datagrams, 5_000), seed=1)
        before, refused = world.system.metrics(victim), world.refusals(victim)
        lines = len(sidecar.log.read_text().splitlines())
        with world.calls():
            sent = fuzzer.ask("fuzz", timeout_s=3600.0, **plan, count=fuzz_datagrams, seed=2)
    asked = world.end_calls()
    world.wait_until_refused(victim, refused, int(sent * 0.8))
    assert sidecar.process.poll() is None
    assert len(sidecar.log.read_text().splitlines()) - lines < LOG_LINES, sidecar.tail()
    after = world.system.metrics(victim)
    memory = "process_resident_memory_bytes"
    assert after[memory] - before[memory] < GROWTH_BYTES
    assert reached_ros(after) - reached_ros(before) <= asked


def reached_ros(metrics: dict[str, float]) -> float:
    """Messages that a sidecar gave to ROS."""
    return sum(
        value
        for series, value in metrics.items()
        if series.startswith("plr_bridge_messages_total")
        and ('direction="request_to_server"' in series or 'direction="answer_to_application"' in series)
    )
