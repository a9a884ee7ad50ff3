from __future__ import annotations

import threading
from typing import TYPE_CHECKING, cast

import pytest

from plr.sidecar.net.engine_turn import EngineTurn

if TYPE_CHECKING:
    from plr.sidecar.core.engine.engine import Engine
    from plr.sidecar.net.interface_thread import InterfaceThread

NOW = 5.0


class Rig:
    """A turn whose outputs are one link to wake; what happens is noted, with whether the lock is held then."""

    def __init__(self) -> None:
        self.lock = threading.RLock()
        self.noted: list[tuple[str, bool]] = []
        self.engine = cast("Engine", self)
        self.booted = 5 * NOW
        self.turn = EngineTurn(self.engine, self.lock, lambda: NOW, self.queue_outputs, lambda: self.booted)

    def note(self, what: str) -> None:
        def try_lock() -> None:
            free = self.lock.acquire(blocking=False)
            if free:
                self.lock.release()
            self.noted.append((what, not free))

        thread = threading.Thread(target=try_lock)  # the lock is reentrant
        thread.start()
        thread.join()

    def queue_outputs(self) -> set[InterfaceThread]:
        self.note("queued")
        return {cast("InterfaceThread", self)}

    def on_woken(self, slept_s: float, now: float) -> None:
        assert now == NOW
        self.note(f"slept {slept_s:g} s")

    def wake(self) -> None:
        self.note("woken")


def test_outputs_are_queued_under_the_lock_and_links_are_woken_after_it() -> None:
    rig = Rig()
    with rig.turn as (engine, now):
        assert (engine, now) == (rig.engine, NOW)
        rig.note("inside")
    assert rig.noted == [("inside", True), ("queued", True), ("woken", False)]


def test_turns_nest() -> None:
    rig = Rig()
    with rig.turn, rig.turn:
        pass
    assert rig.noted == [("queued", True), ("woken", True), ("queued", True), ("woken", False)]


def test_an_error_in_the_turn_frees_the_lock_and_queues_nothing() -> None:
    rig = Rig()
    with pytest.raises(ZeroDivisionError), rig.turn:
        raise ZeroDivisionError
    rig.note("afterwards")
    assert rig.noted == [("afterwards", False)]


def test_an_error_of_the_outputs_frees_the_lock() -> None:
    rig = Rig()

    def fail() -> set[InterfaceThread]:
        raise ZeroDivisionError

    turn = EngineTurn(rig.engine, rig.lock, lambda: NOW, fail)
    with pytest.raises(ZeroDivisionError), turn:
        pass
    rig.note("afterwards")
    assert rig.noted == [("afterwards", False)]


def test_the_engine_learns_first_that_the_host_was_suspended() -> None:
    rig = Rig()
    rig.booted += 70.0
    for _ in range(2):
        with rig.turn:
            rig.note("turn")
    assert [what for what, _ in rig.noted] == ["slept 70 s", "turn", "queued", "woken", "turn", "queued", "woken"]
