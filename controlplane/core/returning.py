"""Who was there before the control plane was restarted, and is not back yet: nobody's lease tells of these.

Times are monotonic seconds.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from protos.fleet_events import Why
from protos.model import Role

if TYPE_CHECKING:
    from collections.abc import Iterable

    from controlplane.core.departed import Departure
    from protos.model import NodeName

TEXT = "it was there before the control plane was restarted, and did not come back"

GOODBYE_TEXT = "it said goodbye to robots while the control plane was away"


def was_stopped(gone: Departure) -> Departure:
    """The same of one that was stopped in order."""
    return replace(gone, why=Why.DRAINED, text=GOODBYE_TEXT)


class Returning:
    """Awaits them, until a time."""

    def __init__(self) -> None:
        self._awaited: dict[NodeName, Departure] = {}
        self._stopped: set[NodeName] = set()
        """Of those, by what robots say."""
        self.until: float | None = None
        """When to ask who is `missing`; None while nobody is awaited."""

    def __len__(self) -> int:
        """How many are awaited."""
        return len(self._awaited)

    def expect(self, present: Iterable[Departure], until: float) -> None:
        """These were there; they are noted as departures should they not come back until then."""
        self._awaited = {one.name: one for one in present}
        self._stopped.clear()
        self.until = until if self._awaited else None

    def is_back(self, name: NodeName) -> None:
        """It is registered."""
        self._awaited.pop(name, None)

    def said_goodbye(self, name: NodeName) -> None:
        """A robot says so of a server."""
        awaited = self._awaited.get(name)
        if awaited is not None and awaited.role is Role.CLOUD:
            self._stopped.add(name)

    def missing(self, now: float) -> list[Departure]:
        """Those that did not come back in time, each once."""
        if self.until is None or self.until > now:
            return []
        gone = [
            was_stopped(replace(one, at=now)) if one.name in self._stopped else replace(one, at=now, text=TEXT)
            for one in self._awaited.values()
        ]
        self._awaited.clear()
        self._stopped.clear()
        self.until = None
        return gone
