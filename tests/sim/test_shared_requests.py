"""Requests that several paths carry together while those paths are cut, slowed down and delayed at random."""

from __future__ import annotations

import functools
import random
from typing import TYPE_CHECKING, NamedTuple

import pytest

from lab.simulated.mesh import SERVICE, Mesh, Node, Wire, rule
from plr.protos.model.redundancy_mode import RedundancyMode
from tests.sim.test_mesh import assert_at_most_once, mapped

if TYPE_CHECKING:
    from collections.abc import Callable

INTERFACES = ("wlan0", "wwan0", "wwan1")
SECONDS = 10.0
LIFETIME_S = 5.0
SEEDS = range(10)


class Drive(NamedTuple):
    """What one robot met and did."""

    robot: Node
    calls: int
    misses: int


def trouble(mesh: Mesh, wires: list[Wire], rng: random.Random) -> None:
    """Give a path a pace, and take some of it away every few seconds."""
    delay_s, pace, loss = rng.uniform(0.005, 0.06), 10 ** rng.uniform(5.3, 6.7), rng.choice((0.0, 0.0, 0.01, 0.05))

    def set_to(*, cut: bool = False, slower: float = 1.0, later_s: float = 0.0) -> None:
        for wire in wires:
            wire.cut, wire.bytes_per_s, wire.delay_s = cut, pace * slower, delay_s + later_s

    for wire in wires:
        wire.loss, wire.jitter_s = loss, 0.003
    set_to()
    at = rng.expovariate(0.25)
    while at < SECONDS:
        severity, length_s = 10 ** rng.uniform(-1.5, 0.0), rng.uniform(0.1, 2.0)
        changes: list[Callable[[], None]] = [
            functools.partial(set_to, cut=True),
            functools.partial(set_to, slower=severity),
            functools.partial(set_to, later_s=0.4 * severity),
        ]
        mesh.at(at, rng.choice(changes))
        mesh.at(at + length_s, set_to)
        at += length_s + rng.expovariate(0.25)


@functools.cache
def drive(mode: RedundancyMode, seed: int, *, idempotent: bool = True) -> Drive:
    """The tests share them."""
    mesh, rng = Mesh(seed), random.Random(seed)
    size = int(10 ** rng.uniform(4.1, 5.1))
    rate_hz = max(1.0, min(rng.choice((2.0, 5.0, 10.0)), 200_000 / size))
    interfaces = INTERFACES[: rng.choice((2, 3))]
    rules = (
        rule(deadline_s=rng.choice((0.3, 0.5, 1.0)), lifetime_s=LIFETIME_S, redundancy=mode, idempotent=idempotent),
    )
    robot = mesh.robot(*interfaces, rules=rules)
    clouds = mesh.cloud("cloud-a"), mesh.cloud("cloud-b")
    mesh.push_views()
    mesh.run(1.0)
    mapped(mesh, robot, *zip(interfaces, ("cloud-a", "cloud-b", "cloud-a"), strict=False))
    for interface in interfaces:
        trouble(mesh, mesh.all_wires_of(f"robot.{interface}"), rng)
    calls = int(SECONDS * rate_hz)
    for number in range(calls):
        robot.submit(number.to_bytes(4, "big") + bytes(size))
        mesh.run(1.0 / rate_hz)
    mesh.run(LIFETIME_S + 1.0)
    assert_at_most_once(*clouds)
    assert all(not node.engine._outbox.held_bytes for node in (robot, *clouds))
    requests = robot.engine.stats.requests
    assert sum(requests.values()) == calls, "each ends once"
    return Drive(robot, calls, calls - requests[SERVICE, "ok"])


@pytest.mark.parametrize("idempotent", [True, False])
def test_each_request_ends_once_and_runs_at_most_once_at_each_server(idempotent: bool) -> None:
    for seed in SEEDS:
        drive(RedundancyMode.SHARE, seed, idempotent=idempotent)


def test_a_request_that_must_not_run_twice_does_not_run_at_two_servers() -> None:
    for seed in SEEDS:
        mesh = drive(RedundancyMode.SHARE, seed, idempotent=False).robot.mesh
        one, other = (set(mesh.nodes[name].executed) for name in ("cloud-a", "cloud-b"))
        assert not one & other


def test_sharing_misses_no_more_than_whole_copies_of_the_same_requests() -> None:
    share, replicate = (
        sum(drive(mode, seed).misses for seed in SEEDS) for mode in (RedundancyMode.SHARE, RedundancyMode.REPLICATE)
    )
    assert replicate >= 10, "there is something to avoid"
    assert share <= 1.1 * replicate
