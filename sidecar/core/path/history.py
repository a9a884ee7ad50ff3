"""Since when each path of one interface is as it is, and why: what was last told of it, for people."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from collections import Counter

    from sidecar.core.base.values import PathId, PathState
    from sidecar.core.seam.links import PathChanged

MAX_REMEMBERED = 4096
"""Paths of one interface, those of peers that left included; then the one that changed longest ago goes."""


class Change(NamedTuple):
    """The last change of a path's liveness."""

    state: PathState
    at: float
    """Monotonic, s."""
    reason: str


class PathHistory:
    """One thread notes, any may ask."""

    def __init__(self, drops: Counter[str]) -> None:
        """What is forgotten for want of room is counted into `drops`."""
        self._drops = drops
        self._last: dict[PathId, Change] = {}

    def note(self, event: PathChanged, now: float) -> None:
        """A path's liveness is told; it may be what was told before."""
        before = self._last.get(event.path)
        if before is not None and before.state is event.state:
            return
        self._last.pop(event.path, None)
        self._last[event.path] = Change(event.state, now, event.reason)
        if len(self._last) > MAX_REMEMBERED:
            del self._last[next(iter(self._last))]
            self._drops["path_history_full"] += 1

    def all(self) -> dict[PathId, Change]:
        """Return the last change of each path, those of peers that left included."""
        return self._last.copy()

    def last(self, path: PathId) -> Change | None:
        """Return the last change of a path, if it is remembered."""
        return self._last.get(path)
