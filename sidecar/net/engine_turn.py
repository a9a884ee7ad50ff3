"""Gives access to the engine for one call: takes its lock, queues what the engine puts out, wakes the links."""

from __future__ import annotations

from typing import TYPE_CHECKING

from plr.sidecar.net.suspension import Suspension, boot_time

if TYPE_CHECKING:
    import threading
    from collections.abc import Callable, Iterable

    from plr.sidecar.core.engine.engine import Engine
    from plr.sidecar.net.interface_thread import InterfaceThread


class EngineTurn:
    """`with turn as (engine, now):` holds the engine's lock, then queues the engine's outputs and wakes their links.

    The outputs are queued under the lock, so they keep the engine's order. The links are woken after it: a woken
    thread asks for the lock first. After an error in the block, the outputs wait for the next turn.

    One object serves all threads, and turns may nest, because it keeps nothing between calls. A generator-based context
    manager would cost every request more.
    """

    __slots__ = ("_boot_clock", "_clock", "_engine", "_lock", "_queue_outputs", "_suspension")

    def __init__(
        self,
        engine: Engine,
        lock: threading.RLock,
        clock: Callable[[], float],
        queue_outputs: Callable[[], Iterable[InterfaceThread]],
        boot_clock: Callable[[], float] = boot_time,
    ) -> None:
        """Use `queue_outputs`, called with the lock held, which returns the links to wake.

        `boot_clock` goes on while the host is suspended: the engine learns of that before anything else.
        """
        self._engine = engine
        self._lock = lock
        self._clock = clock
        self._queue_outputs = queue_outputs
        self._boot_clock = boot_clock
        self._suspension = Suspension(clock(), boot_clock())

    def __enter__(self) -> tuple[Engine, float]:
        """Return the engine, and the time."""
        self._lock.acquire()
        try:
            now, booted = self._clock(), self._boot_clock()
            if booted - now >= self._suspension.noticed_at_s:
                self._engine.on_woken(self._suspension.slept_s(now, booted), now)
        except BaseException:
            self._lock.release()
            raise
        return self._engine, now

    def __exit__(self, error: type[BaseException] | None, *_: object) -> None:
        """End the turn."""
        woken: Iterable[InterfaceThread] = ()
        try:
            if error is None:
                woken = self._queue_outputs()
        finally:
            self._lock.release()
        for link in woken:
            link.wake()
