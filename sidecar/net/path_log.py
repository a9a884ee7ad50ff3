"""Logs when a path goes down and when it comes (back) up; short wobbles between go to debug."""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING

from plr.sidecar.core.base.values import PathState

if TYPE_CHECKING:
    from plr.sidecar.core.base.values import PathId
    from plr.sidecar.core.seam.links import PathChanged

log = logging.getLogger(__name__)


class PathLog:
    """Remembers what was last logged about each path of one interface; one thread uses it."""

    def __init__(self) -> None:
        self._said: dict[PathId, PathState] = {}

    def note(self, event: PathChanged) -> None:
        """Log the change if it is one between up and down."""
        path, state = event.path, event.state
        if state is PathState.UNSTABLE or self._said.get(path, PathState.DOWN) is state:
            log.debug("path %s to %s: %s (%s)", path.interface, path.peer, state.value, event.reason)
            return
        level = logging.WARNING if state is PathState.DOWN else logging.INFO
        log.log(level, "path %s to %s is %s: %s", path.interface, path.peer, state.value, event.reason)
        if state is PathState.DOWN:
            del self._said[path]
        else:
            self._said[path] = state
