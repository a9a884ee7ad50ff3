"""Requests over a slow link in simulated time: the queue stands in the sender, and what can be in time is in time."""

from __future__ import annotations

import random
from typing import TYPE_CHECKING, NamedTuple

import pytest

from lab.simulated.mesh import Mesh, Node, Wire, rule
from plr.sidecar.core.path.congestion.model_controller import ModelController
from plr.sidecar.core.path.turn import Turn

if TYPE_CHECKING:
    from plr.sidecar.core.base.values import ExecutionId, RequestId

MBIT = 1e6 / 8
HZ = 10


class World:
    """A robot with one interface and one server, whose answers are short."""

    def __init__(self, rate: float, delay_s: float, *, seed: int = 1, **rules: object) -> None:
        self.mesh = Mesh(seed)
        self.robot: Node = self.mesh.robot("wlan0", rules=(rule(**rules),))
        cloud = self.mesh.cloud("cloud-a")
        self.mesh.push_views()
        self.up, self.down = self.mesh.both_ways("robot.wlan0", "cloud-a.eth0")
        for wire in (self.up, self.down):
            wire.delay_s, wire.bytes_per_s = delay_s, rate
        complete = cloud.engine.cloud.complete

        def answer(execution: ExecutionId, payload: bytes, server_s: float, now: float) -> None:
            complete(execution, payload[:9], server_s, now)

        cloud.engine.cloud.complete = answer  # type: ignore[method-assign,assignment]  # an echo of 100 kB would pace both ways
        self.mesh.run(1.0)

    @property
    def control(self) -> ModelController:
        (link,) = self.robot.links.values()
        (path,) = link._paths.values()
        assert isinstance(path.control, ModelController)
        return path.control

    def request(self, size: int, seconds: float, hz: int = HZ) -> list[RequestId]:
        """Send requests at that rate for so long; forgets the longest wait in the network before."""
        self.up.longest_wait_s = 0.0
        ids = []
        for _ in range(int(seconds * hz)):
            self.mesh.calls += 1
            ids.append(self.robot.submit(self.mesh.calls.to_bytes(4, "big") + bytes(size)))
            self.mesh.run(1 / hz)
        return ids

    def elapsed(self, ids: list[RequestId]) -> list[float]:
        answers = {event.request_id: event.elapsed_s for event in self.robot.responses()}
        return [answers[request_id] for request_id in ids if request_id in answers]


@pytest.mark.parametrize(("rate", "delay_s"), [(20 * MBIT, 0.025), (100 * MBIT, 0.025), (500 * MBIT, 0.0005)])
def test_bursts_with_pauses_measure_the_link_and_keep_the_rate(rate: float, delay_s: float) -> None:
    world, size = World(rate, delay_s, deadline_s=0.5), 150_000
    world.request(size, 2.5)
    later = world.request(size, 2.0)
    assert world.control.rate.best == pytest.approx(rate, rel=0.15)
    world.mesh.run(0.5)
    elapsed = world.elapsed(later)
    assert len(elapsed) == len(later)
    assert sorted(elapsed)[len(elapsed) // 2] < 1.15 * (size / rate + 2 * delay_s) + 0.002
    assert world.up.longest_wait_s < 0.012


@pytest.mark.parametrize("size", [2_000, 9_000, 25_000, 120_000])
def test_a_pause_between_requests_is_known_to_be_one(size: int) -> None:
    """Also when the last symbols of a request use up what pacing allows."""
    world = World(2.4 * MBIT, 0.050)
    for _ in range(20):
        world.request(size, 0.01, hz=100)
        world.mesh.run(2.0)
        assert world.control.rate.is_dry


def test_a_rate_that_drops_is_believed_and_so_is_one_that_rises() -> None:
    world = World(20 * MBIT, 0.025, deadline_s=0.5)
    world.request(60_000, 3.0)
    world.up.bytes_per_s = 2 * MBIT
    world.request(60_000, 1.0)
    assert world.control.rate.best < 3 * MBIT
    world.request(60_000, 1.5)
    world.request(60_000, 1.0)
    assert world.up.longest_wait_s < 0.1
    world.up.bytes_per_s = 20 * MBIT
    world.request(60_000, 3.0)
    assert world.control.rate.best > 15 * MBIT


def test_overload_stands_in_the_sender_and_not_in_the_network() -> None:
    world = World(2 * MBIT, 0.025, deadline_s=0.5)
    world.request(120_000, 3.0)
    assert world.up.longest_wait_s < 0.16  # the first 32 kB, sent while nothing was known
    world.request(120_000, 10.0)
    assert world.up.longest_wait_s < 0.1
    assert world.up.overflowed == 0
    assert world.control.rate.best == pytest.approx(2 * MBIT, rel=0.15)


def in_time_under_twice_the_load(deadline_s: float) -> float:
    """The share of what the link can carry at all that is answered in time."""
    world = World(4.8 * MBIT, 0.010, deadline_s=deadline_s)
    ids = world.request(120_000, 15.0)
    world.mesh.run(1.0)
    return sum(elapsed <= deadline_s for elapsed in world.elapsed(ids)) / (len(ids) / 2)


@pytest.mark.parametrize("deadline_s", [0.3, 0.5, 1.0])
def test_under_twice_the_load_most_that_can_be_in_time_is(deadline_s: float) -> None:
    assert in_time_under_twice_the_load(deadline_s) > 0.72


def test_earliest_deadline_first_alone_would_collapse(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Turn, "can_end_by", lambda *_: True)
    assert in_time_under_twice_the_load(0.5) < 0.2


def test_after_an_outage_the_backlog_does_not_flood_the_link() -> None:
    world = World(4 * MBIT, 0.025, deadline_s=0.5, lifetime_s=20.0)
    before = world.request(20_000, 3.0)
    cut(world, cut=True)
    during = world.request(20_000, 5.0)
    cut(world, cut=False)
    after = world.request(20_000, 5.0)
    assert world.up.longest_wait_s < 0.1
    world.mesh.run(3.0)
    assert len(world.elapsed(before + during + after)) == len(before + during + after)
    assert sorted(world.elapsed(after))[len(after) // 2] < 0.25


def cut(world: World, *, cut: bool) -> None:
    wires: list[Wire] = world.mesh.all_wires_of("robot.wlan0")
    for wire in wires:
        wire.cut = cut


def test_losing_all_that_is_in_flight_does_not_stall_the_path() -> None:
    world = World(20 * MBIT, 0.025, deadline_s=0.5)
    world.request(150_000, 3.0)
    cut(world, cut=True)
    ids = world.request(150_000, 0.1)
    cut(world, cut=False)
    world.mesh.run(2.0)
    assert world.elapsed(ids)
    assert max(world.elapsed(ids)) < 0.6


def test_a_route_that_gets_longer_for_a_while_and_a_radio_that_loses_some_are_no_congestion() -> None:
    """One run is chance: of sixty, each with other losses, one in ten has an answer after more than 0.24 s."""
    runs = [lossy_radio(seed) for seed in range(1, 8)]
    worst = sorted(run.worst_s for run in runs)
    assert worst[len(runs) // 2] < 0.25
    ceilings = sorted(run.ceiling for run in runs)
    assert ceilings[len(runs) // 2] > 100_000


@pytest.mark.audit("dp-13")
@pytest.mark.parametrize("loss", [0.03, 0.10])
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_route_that_gets_longer_and_lossier_at_one_moment_is_no_congestion(loss: float, seed: int) -> None:
    """As at a cell's edge. Taken for a full queue, it answered in 1.9 s in the middle, and one in three too late."""
    world = World(1000 * MBIT, 0.020, seed=seed, deadline_s=2.0, lifetime_s=30.0)
    world.request(3000, 8.0)
    for wire in (world.up, world.down):
        wire.delay_s, wire.loss = 0.150, loss
    ids = world.request(3000, 32.0)
    world.mesh.run(3.0)
    elapsed = sorted(world.elapsed(ids))
    assert len(elapsed) == len(ids)
    assert elapsed[len(elapsed) // 2] < 0.35
    assert elapsed[-1] < 2.0


class LossyRun(NamedTuple):
    worst_s: float
    """Until the latest answer came."""
    ceiling: float
    """Of the window at the end (bytes)."""


def lossy_radio(seed: int) -> LossyRun:
    """Ask for 15 s over a route whose length changes, and which loses what the seed says."""
    size, usual_s = 120_000, 0.025
    world = World(20 * MBIT, usual_s, seed=seed, deadline_s=1.0)
    rng = random.Random(seed)
    world.request(size, 2.0)
    later = []
    for _ in range(15):
        for wire in (world.up, world.down):
            wire.delay_s, wire.loss = usual_s * rng.uniform(0.8, 1.6), 0.003
        later += world.request(size, 1.0, hz=5)
    ceiling = world.control.ceiling.bytes
    world.mesh.run(2.0)
    elapsed = sorted(world.elapsed(later))
    assert len(elapsed) == len(later)
    assert elapsed[len(elapsed) // 2] < 0.15
    return LossyRun(elapsed[-1], float("inf") if ceiling is None else ceiling)


@pytest.mark.audit("dp-13")
@pytest.mark.parametrize(("lifetime_s", "answered"), [(10.0, 0.78), (30.0, 0.99)])
def test_in_spells_of_too_little_the_late_are_answered_oldest_first(lifetime_s: float, answered: float) -> None:
    """By turns 20 s at a third of what is asked and 20 s at four times that. Newest first answers 0.74 and 0.94."""
    world = World(6 * MBIT, 0.030, deadline_s=1.0, lifetime_s=lifetime_s)
    ids = []
    for _ in range(4):
        world.up.bytes_per_s = 0.5 * MBIT
        ids += world.request(100_000, 20.0, hz=2)
        world.up.bytes_per_s = 6 * MBIT
        ids += world.request(100_000, 20.0, hz=2)
    world.mesh.run(lifetime_s)
    elapsed = world.elapsed(ids)
    assert len(elapsed) >= answered * len(ids)
    assert sum(took <= 1.0 for took in elapsed) >= 0.45 * len(ids)
