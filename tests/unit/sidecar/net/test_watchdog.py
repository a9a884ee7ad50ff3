from __future__ import annotations

from typing import TYPE_CHECKING, cast

from plr.sidecar.net.watchdog import HUNG_AFTER_S, LOOK_EVERY_S, ThreadChanges, Watchdog

if TYPE_CHECKING:
    from plr.sidecar.net.interface_thread import InterfaceThread


class FakeThread:
    """Began its turn at that time; None while it waits."""

    def __init__(self) -> None:
        self.began: float | None = None
        self.in_a_call = True

    def in_turn_for(self, now: float) -> float:
        return 0.0 if self.began is None else now - self.began

    def is_in_a_call(self) -> bool:
        return self.in_a_call


class Fixture:
    def __init__(self) -> None:
        self.now = 100.0
        self.dog = Watchdog(self.now)
        self.fakes = [FakeThread(), FakeThread()]

    @property
    def threads(self) -> list[InterfaceThread]:
        return [cast("InterfaceThread", fake) for fake in self.fakes]

    def look_until(self, end: float) -> list[ThreadChanges]:
        found = []
        while self.now < end:
            self.now += LOOK_EVERY_S
            changes = self.dog.look(self.threads, self.now)
            if changes is not None:
                found.append(changes)
        return found


def test_a_long_turn_is_told_once_and_so_is_its_end() -> None:
    world = Fixture()
    good, bad = world.threads
    world.fakes[1].began = world.now
    assert world.look_until(105.0) == [ThreadChanges([bad], [])]
    assert world.dog.hangs(bad)
    assert not world.dog.hangs(good)
    world.fakes[1].began = world.now  # the next turn
    assert world.look_until(world.now + HUNG_AFTER_S / 2) == [ThreadChanges([], [bad])]
    assert not world.dog.hangs(bad)


def test_turns_that_end_are_none_of_its_business() -> None:
    world = Fixture()
    for _ in range(50):
        world.fakes[0].began = world.now
        assert world.look_until(world.now + HUNG_AFTER_S - LOOK_EVERY_S) == []


def test_a_machine_that_stalled_blames_no_driver() -> None:
    world = Fixture()
    world.fakes[0].began = world.fakes[1].began = world.now
    world.now += 10.0
    assert world.dog.look(world.threads, world.now) is None
    world.fakes[0].began = None
    assert world.look_until(world.now + LOOK_EVERY_S) == [ThreadChanges([world.threads[1]], [])]


def test_a_thread_that_was_taken_away_is_forgotten() -> None:
    world = Fixture()
    world.fakes[1].began = world.now
    world.look_until(101.0)
    gone = world.threads[1]
    del world.fakes[1]
    assert world.look_until(102.0) == []
    assert not world.dog.hangs(gone)


def test_a_thread_that_does_not_get_to_run_blames_no_driver() -> None:
    world = Fixture()
    world.fakes[0].began = world.now
    world.fakes[0].in_a_call = False
    assert world.look_until(105.0) == []
    world.fakes[0].in_a_call = True
    assert world.look_until(106.0) == [ThreadChanges([world.threads[0]], [])]
    world.fakes[0].in_a_call = False  # back from the driver, and it waits for the interpreter
    assert world.look_until(107.0) == []
    world.fakes[0].began = None
    assert world.look_until(108.0) == [ThreadChanges([], [world.threads[0]])]
