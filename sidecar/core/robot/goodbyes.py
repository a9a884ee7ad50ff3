"""Robot side: remembers which servers said goodbye. A control plane that was away then would take them for dead.

Each goodbye is reported while the control plane's view lists the server, and once more after that.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from plr.protos.model.report import MAX_GOODBYES

if TYPE_CHECKING:
    from collections.abc import Callable

    from plr.protos.model.ids import NodeName, SessionId


class Goodbyes:
    """Servers, each with the session that ended. When there are too many, the earliest goodbye is forgotten."""

    def __init__(self) -> None:
        self._sessions: dict[NodeName, SessionId] = {}
        self._unlisted: set[NodeName] = set()

    def note(self, server: NodeName, session: SessionId) -> None:
        """Note that a server said goodbye."""
        self.is_back(server)
        self._sessions[server] = session
        if len(self._sessions) > MAX_GOODBYES:
            self.is_back(next(iter(self._sessions)))

    def is_back(self, server: NodeName) -> None:
        """Forget the goodbye of a server that answers again."""
        self._sessions.pop(server, None)
        self._unlisted.discard(server)

    def follow(self, session_of: Callable[[NodeName], SessionId | None]) -> None:
        """Follow a new view of the peers; `session_of` returns a server's session in it, None if the view lacks it."""
        for server, ended in list(self._sessions.items()):
            session = session_of(server)
            if session is None:
                self._unlisted.add(server)
            elif session != ended:
                self.is_back(server)

    def report(self) -> tuple[NodeName, ...]:
        """Return all servers to report now."""
        told = tuple(self._sessions)
        for server in list(self._unlisted):
            self.is_back(server)
        return told
