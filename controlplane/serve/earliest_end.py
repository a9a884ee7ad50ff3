"""Tracks when the first of many certificates expires, without scanning all of them until one does."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterable

    from plr.protos.model.ids import NodeName


class EarliestEnd:
    """The earliest expiry among the certificates in use; times are seconds since 1970."""

    def __init__(self) -> None:
        self._at = math.inf

    def note(self, end: float) -> None:
        """Note one more certificate in use."""
        self._at = min(self._at, end)

    def ended(self, in_use: Iterable[tuple[NodeName, float]], now: float) -> list[NodeName]:
        """Return whose have expired by `now`; scan `in_use` only if one has, or if the former earliest is gone."""
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
