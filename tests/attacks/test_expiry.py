"""A robot whose certificate ends while it runs, with everything else well: refused like a stranger, at once."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

import pytest

from lab.system import read_json
from plr.controlplane.ca.certificates import Validity
from plr.protos.trust.identity import IdentityRole
from tests.attacks.world import SERVICES

if TYPE_CHECKING:
    from tests.attacks.world import World

pytestmark = [pytest.mark.netns, pytest.mark.ros, pytest.mark.timeout(240)]

LIFE_S = 35.0
CALLS_S = 55
SETTLED_S = 5.0
"""ROS drops answers to a client that it has only just found."""
LATE_S = 5.0
"""After the end, for a look at the clock and for what was on its way: generous for a busy machine."""
ROBOT_2 = "robot-2"


@pytest.mark.audit("sec-6")
def test_a_certificate_that_ends_takes_its_living_session_with_it(world: World) -> None:
    system = world.system
    ends_at = time.time() + LIFE_S
    validity = Validity(ends_at - LIFE_S - 300, ends_at)
    system.authority.write_tls_dir(system.folder / f"{ROBOT_2}.tls", ROBOT_2, IdentityRole.ROBOT, validity=validity)
    system._certified.add(ROBOT_2)
    robot = system.start_robot(SERVICES, name=ROBOT_2, host="robot_2", interfaces=["eth9"])
    system.wait_for_offer(robot)
    out = system.folder / "expiry.json"
    argv = ["-m", "lab.echo", "call", "--rate", "5", "--duration", str(CALLS_S), "--json", str(out)]
    with world.calls():
        system.start_node("expiry.client", "robot_2", argv).process.wait(CALLS_S + 60)
        del system.parts["expiry.client"]
    requests = [(one["sent_wall_s"], one["latency_ms"]) for one in read_json(out)["requests"]]
    settled_at = requests[0][0] + SETTLED_S
    before = [latency for sent_at, latency in requests if settled_at < sent_at < ends_at - LATE_S]
    after = [latency for sent_at, latency in requests if sent_at > ends_at + LATE_S]
    assert before
    assert None not in before
    assert len(after) > 10
    assert set(after) == {None}
    for part in ("cloud_a.sidecar", "cloud_b.sidecar"):
        # By its own look at the clock, or told by the control plane: whoever is first.
        assert f"to {ROBOT_2} is down" in system.parts[part].log.read_text()
    assert world.counter("control", "plr_departures_total", reason="expired") >= 1
