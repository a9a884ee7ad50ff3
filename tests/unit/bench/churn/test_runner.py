"""The runner against hands that only note what they are told, on a clock of its own."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import pytest

from bench.churn import runner as module
from bench.churn.runner import Runner
from bench.churn.schedule import Kind, Lane, Trouble, make_schedule

if TYPE_CHECKING:
    from collections.abc import Iterable


class Clock:
    """Time that passes only while somebody sleeps."""

    def __init__(self) -> None:
        self.now = 1000.0

    def monotonic(self) -> float:
        return self.now

    def sleep(self, seconds: float) -> None:
        self.now += seconds


class Hands:
    """Things come back `slow_s` after their trouble ended."""

    def __init__(self, clock: Clock, slow_s: float) -> None:
        self.system: Any = type("System", (), {"parts": {}})()
        self.in_trouble: dict[str, Trouble] = {}
        self.worst: list[set[str]] = []
        self._clock = clock
        self._slow_s = slow_s
        self._ended: dict[str, float] = {}

    def begin(self, trouble: Trouble) -> None:
        assert trouble.target not in self.in_trouble
        self.in_trouble[trouble.target] = trouble
        self._ended.pop(trouble.target, None)
        self.worst.append(set(self.in_trouble) | set(self._ended))

    def end(self, trouble: Trouble) -> None:
        del self.in_trouble[trouble.target]
        self._ended[trouble.target] = self._clock.now

    def works(self, lane: Lane, target: str, well: frozenset[str]) -> bool:
        assert target not in well
        if self._clock.now < self._ended[target] + self._slow_s:
            return False
        del self._ended[target]
        return True


def play(
    monkeypatch: pytest.MonkeyPatch, schedule: Iterable[Trouble], length_s: float, slow_s: float
) -> tuple[Runner, Hands]:
    clock = Clock()
    monkeypatch.setattr(module, "time", clock)
    hands = Hands(clock, slow_s)
    runner = Runner(hands, schedule, length_s, lambda line: None)  # type: ignore[arg-type]  # hands that only note what they do
    runner.run([], [], lambda line: None)
    return runner, hands


@pytest.mark.parametrize("slow_s", [0.1, 5.0, 20.0])
def test_never_are_both_paths_or_both_servers_away_however_slowly_things_come_back(
    monkeypatch: pytest.MonkeyPatch, slow_s: float
) -> None:
    runner, hands = play(monkeypatch, make_schedule(3, 600.0), 600.0, slow_s)
    assert len(runner.done) > 20
    assert runner.failures == []
    for away in hands.worst:
        assert not {"wlan0", "wwan0"} <= away
        assert not {"cloud_a", "cloud_b"} <= away
    assert not hands.in_trouble, "everything is undone at the end"


def test_slow_returns_put_the_rest_of_their_lane_off_and_no_other(monkeypatch: pytest.MonkeyPatch) -> None:
    runner, _ = play(monkeypatch, make_schedule(3, 600.0), 600.0, 20.0)
    assert runner.postponed_s["servers"] > 0
    assert runner.postponed_s["control"] == 0


def test_what_does_not_come_back_is_a_failure_said_once(monkeypatch: pytest.MonkeyPatch) -> None:
    trouble = Trouble(Lane.PATHS, Kind.UNPLUG, "wlan0", 5.0, 1.0)
    runner, _ = play(monkeypatch, [trouble, Trouble(Lane.PATHS, Kind.UNPLUG, "wwan0", 10.0, 1.0)], 200.0, 1e9)
    assert len(runner.failures) == 1
    assert [done.trouble for done in runner.done] == [trouble], "the other path is all that is left"
