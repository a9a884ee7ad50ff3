"""Troubles of one real interface, while calls go over both: the good one must not feel them.

The limit is the same calls without trouble, and the trouble's own length, never a time of its own.
"""

from __future__ import annotations

import contextlib
from typing import TYPE_CHECKING

import pytest

from bench.dataplane.ours import Ours
from bench.dataplane.topology import CARRIERS, ROBOT, SilentCut, cables
from lab import Lab

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from bench.dataplane.statistics import Calls
    from lab import Host

pytestmark = pytest.mark.netns

GOOD, BAD = CARRIERS
RATE_HZ = 50.0
COUNT = 100
TROUBLE_S = COUNT / RATE_HZ
SIZE = 20_000


@pytest.fixture(scope="module")
def lab() -> Iterator[Lab]:
    with Lab(cables()) as running:
        yield running


@pytest.fixture
def ours(lab: Lab, tmp_path: Path) -> Iterator[Ours]:
    with Ours.in_lab(lab, tmp_path) as running:
        yield running


def call(ours: Ours) -> list[float]:
    """Latencies of the calls (s), the shortest first; all are answered."""
    calls: Calls = ours.call(size=SIZE, count=COUNT, rate_hz=RATE_HZ, grace_s=20.0)
    found = sorted(latency for latency in calls.latency_s if latency is not None)
    assert len(found) == COUNT
    return found


def unharmed(troubled: list[float], calm: list[float]) -> bool:
    at = COUNT * 9 // 10
    return troubled[at] < 20 * calm[at] and troubled[-1] < max(TROUBLE_S / 2, 20 * calm[-1])


def tc(host: Host, command: str) -> None:
    done = host.run(["tc", *command.split()])
    assert done.returncode == 0, done.stderr


@contextlib.contextmanager
def stuck_queue(host: Host, interface: str) -> Iterator[None]:
    """The device takes next to nothing and its queue drops nothing: the socket's buffer fills."""
    tc(host, f"qdisc add dev {interface} root tbf rate 8kbit burst 3000 limit 50000000")
    try:
        yield
    finally:
        tc(host, f"qdisc del dev {interface} root")


@contextlib.contextmanager
def unplugged(host: Host, interface: str) -> Iterator[None]:
    host.link_down(interface)
    try:
        yield
    finally:
        host.link_up(interface)


@contextlib.contextmanager
def silent(lab: Lab, interface: str) -> Iterator[None]:
    cut = SilentCut(lab)
    cut.cut(interface)
    try:
        yield
    finally:
        cut.mend()


@pytest.mark.parametrize("trouble", ["stuck queue", "cable unplugged", "silence"])
def test_the_good_interface_does_not_feel_it(lab: Lab, ours: Ours, trouble: str) -> None:
    robot = lab.host(ROBOT)
    call(ours)
    calm = call(ours)
    with {
        "stuck queue": lambda: stuck_queue(robot, BAD),
        "cable unplugged": lambda: unplugged(robot, BAD),
        "silence": lambda: silent(lab, BAD),
    }[trouble]():
        troubled = call(ours)
    assert unharmed(troubled, calm)
    link = ours.robot.ask("counters")["links"][BAD]
    assert link["dropped"].get("internal_error", 0) == 0
    # And what it kept back is not let loose on the network when the interface is well again.
    before = link["bytes"]["sent"]
    assert unharmed(call(ours), calm)
    after = ours.robot.ask("counters")["links"][BAD]["bytes"]["sent"]
    assert after - before < 2.5 * COUNT * SIZE
