"""Remembers since when and why each path of one interface has its state, for people."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from collections import Counter

    from plr.sidecar.core.base.values import PathId, PathState
    from plr.sidecar.core.seam.links import PathChanged

MAX_CHANGED_PATHS = 4096
"""Paths remembered per interface, those of departed peers included. Beyond it the one that changed longest ago goes."""


class LivenessChange(NamedTuple):
    """The last change of a path's liveness."""

    state: PathState
    at: float
    """Monotonic, s."""
    reason: str


class PathHistory:
    """The last change of each path. One thread writes, any may read."""

    def __init__(self, drops: Counter[str]) -> None:
        """Entries dropped for lack of room are counted into `drops`."""
        self._drops = drops
        self._last: dict[PathId, LivenessChange] = {}

    def note(self, event: PathChanged, now: float) -> None:
        """Note a reported liveness; it may repeat the last one."""
        before = self._last.get(event.path)
        if before is not None and before.state is event.state:
            return
        self._last.pop(event.path, None)
        self._last[event.path] = LivenessChange(event.state, now, event.reason)
        if len(self._last) > MAX_CHANGED_PATHS:
            del self._last[next(iter(self._last))]
            self._drops["path_history_full"] += 1

    def all(self) -> dict[PathId, LivenessChange]:
        """Return the last change of each path, those of departed peers included."""
        return self._last.copy()

    def last(self, path: PathId) -> LivenessChange | None:
        """Return the last change of a path, if it is remembered."""
        return self._last.get(path)
