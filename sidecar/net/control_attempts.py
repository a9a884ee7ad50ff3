"""Makes several connections to the control plane at once."""

from __future__ import annotations

import asyncio
import os
from typing import TYPE_CHECKING

from plr.sidecar.net.control_sockets import open_stream

if TYPE_CHECKING:
    import socket

    from plr.sidecar.core.control.ways import ControlWays, Way

STALE_ATTEMPT_S = 1.0
"""Age at which an attempt starts again when the network changes: the kernel repeats its first packet ever more
rarely."""


class Attempts:
    """Connections being made."""

    def __init__(self) -> None:
        self._tasks: dict[Way, tuple[asyncio.Task[socket.socket], float]] = {}

    def start(self, way: Way, now: float) -> None:
        """Start to connect over a way."""
        self._tasks[way] = asyncio.create_task(_connected(way)), now

    def keep(self, now: float, ways: ControlWays) -> list[Way]:
        """Give up attempts that are old or whose interface is gone; return the others."""
        for way, (task, began) in list(self._tasks.items()):
            gone = way.interface is not None and not ways.has(way.interface)
            if gone or now > began + STALE_ATTEMPT_S:
                task.cancel()
                task.add_done_callback(_discard)
                del self._tasks[way]
        return list(self._tasks)

    async def wait(self, wake: asyncio.Event, timeout_s: float | None) -> None:
        """Wait until an attempt ends, something changes, or the time is over."""
        waking = asyncio.create_task(wake.wait())
        try:
            tasks = [waking, *(task for task, _ in self._tasks.values())]
            await asyncio.wait(
                tasks, timeout=None if timeout_s is None else max(timeout_s, 0.0), return_when=asyncio.FIRST_COMPLETED
            )
        finally:
            waking.cancel()

    def take_ended(self) -> list[tuple[Way, socket.socket | OSError]]:
        """Remove and return the attempts that have ended, up to the first that connected."""
        ended: list[tuple[Way, socket.socket | OSError]] = []
        for way, (task, _) in list(self._tasks.items()):
            if not task.done():
                continue
            del self._tasks[way]
            error = task.exception()
            if error is None:
                return [(way, task.result())]
            ended.append((way, error if isinstance(error, OSError) else OSError(str(error))))
        return ended

    def close(self) -> None:
        """Give up all attempts."""
        for task, _ in self._tasks.values():
            task.cancel()
            task.add_done_callback(_discard)
        self._tasks.clear()


def words(error: OSError) -> str:
    """Return the kernel's words for an error; asyncio replaces them with its own, which include the address."""
    return str(error) if error.errno is None else os.strerror(error.errno)


def _discard(task: asyncio.Task[socket.socket]) -> None:
    if not task.cancelled() and task.exception() is None:
        task.result().close()


async def _connected(way: Way) -> socket.socket:
    sock = open_stream(way)
    try:
        await asyncio.get_running_loop().sock_connect(sock, way.address)
    except BaseException:
        sock.close()
        raise
    return sock
