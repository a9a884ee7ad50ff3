"""Scans of the graph: a little of each in one go, a rest after each, and none while nothing changes."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from plr.sidecar.ros.graph.scans import FIRST_SETTLING_S, IDLE_PERIOD_S, REST, TURN_S, Scans

if TYPE_CHECKING:
    from collections.abc import Iterator

STEP_S = 0.0001
"""What a step takes: one of some hundred services."""


class Graph:
    """A scan of it takes `services` steps; the clock runs only while it is scanned."""

    def __init__(self, services: int) -> None:
        self.services = services
        self.now = 0.0
        self.scans = 0
        self.settling = False
        self.fails = False
        self.made = Scans(self.begin, lambda: self.settling, self.now, lambda: self.now)

    def begin(self) -> Iterator[None]:
        for _ in range(self.services):
            self.now += STEP_S
            yield
        if self.fails:
            raise RuntimeError("rmw is broken")
        self.scans += 1

    def run_until(self, end: float) -> list[float]:
        """Turn whenever it is due; returns how long each turn took."""
        took = []
        while (due := self.made.next_due()) <= end:
            self.now = began = max(self.now, due)
            self.made.turn(self.now)
            took.append(self.now - began)
        self.now = max(self.now, end)
        return took


@pytest.mark.audit("dp-10")
def test_a_scan_of_many_services_is_done_in_short_turns() -> None:
    graph = Graph(services=400)
    took = graph.run_until(1.0)
    assert graph.scans == 1
    assert len(took) == pytest.approx(400 * STEP_S / TURN_S, abs=2)
    assert max(took) < TURN_S + 2 * STEP_S


@pytest.mark.audit("dp-10")
def test_without_a_change_the_graph_is_hardly_scanned() -> None:
    graph = Graph(services=400)
    graph.run_until(60.0)
    assert graph.scans <= 60.0 / IDLE_PERIOD_S + 1


def test_a_change_is_followed_by_a_scan_at_once() -> None:
    graph = Graph(services=10)
    graph.run_until(1.0)
    graph.made.changed(graph.now)
    assert graph.made.next_due() == graph.now
    graph.run_until(graph.now)
    assert graph.scans == 2


@pytest.mark.audit("dp-10")
def test_changes_without_end_take_a_tenth_of_the_time() -> None:
    graph = Graph(services=400)
    spent = 0.0
    while graph.now < 10.0:
        graph.made.changed(graph.now)
        spent += sum(graph.run_until(graph.now + 0.001))
    assert spent / graph.now < 1.1 / (1.0 + REST)
    assert graph.scans > 10.0 * 0.8 / ((1.0 + REST) * 400 * STEP_S)


def test_a_change_during_a_scan_is_followed_by_another() -> None:
    graph = Graph(services=400)
    graph.made.turn(graph.now)
    graph.made.changed(graph.now)
    graph.run_until(graph.now + 2.0)
    assert graph.scans == 2


def test_while_something_settles_scans_follow_ever_more_rarely() -> None:
    graph = Graph(services=1)
    graph.settling = True
    graph.run_until(0.5)
    assert graph.scans >= 4
    graph.run_until(600.0)
    assert graph.scans < 600.0 / IDLE_PERIOD_S + 12
    graph.made.changed(graph.now)
    scans, now = graph.scans, graph.now
    graph.run_until(now + 3 * FIRST_SETTLING_S)
    assert graph.scans >= scans + 2


def test_a_scan_that_fails_is_repeated_in_its_time() -> None:
    graph = Graph(services=3)
    graph.fails = True
    with pytest.raises(RuntimeError):
        graph.made.turn(graph.now)
    graph.fails = False
    assert graph.made.next_due() > graph.now
    graph.run_until(graph.now + IDLE_PERIOD_S)
    assert graph.scans == 1
