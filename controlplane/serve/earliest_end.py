"""When the first of many certificates ends: known without a look at all of them, until one does."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterable

    from protos.model.ids import NodeName


class EarliestEnd:
    """Times are seconds since 1970."""

    def __init__(self) -> None:
        self._at = math.inf

    def note(self, end: float) -> None:
        """One more is in use."""
        self._at = min(self._at, end)

    def ended(self, in_use: Iterable[tuple[NodeName, float]], now: float) -> list[NodeName]:
        """Whose have ended by `now`; `in_use` is looked at only if some has, or one that was the first is gone."""
        if now <= self._at:
            return []
        found: list[NodeName] = []
        self._at = math.inf
        for name, end in in_use:
            if end < now:
                found.append(name)
            else:
                self.note(end)
        return found
