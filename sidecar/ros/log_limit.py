"""Limits logging on the hot path: the first line of a kind at once, then a count of the rest once per period."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import logging

LOG_PERIOD_S = 5.0
"""An operator can read one line of a kind every few seconds; more would hide the other kinds."""
MAX_KINDS = 512
"""Kinds are (what happened, service); beyond this many, the kind not logged for longest is forgotten."""


@dataclass(slots=True)
class _Kind:
    logged_at: float
    suppressed: int = 0


class LimitedLog:
    """Writes to `logger` at most one line of a kind per period, and says how many it left out."""

    __slots__ = ("_kinds", "_logger", "_period_s")

    def __init__(self, logger: logging.Logger, period_s: float = LOG_PERIOD_S) -> None:
        self._logger = logger
        self._period_s = period_s
        self._kinds: dict[tuple[str, str], _Kind] = {}

    def log(
        self, level: int, kind: tuple[str, str], now: float, message: str, *args: object, exc_info: bool = False
    ) -> None:
        """Log `message % args` under `kind`, or only count it."""
        known = self._kinds.get(kind)
        if known is not None and now - known.logged_at < self._period_s:
            known.suppressed += 1
            return
        if known is not None and known.suppressed:
            message = f"{message} (and %d more like this in the last %.0f s)"
            args = (*args, known.suppressed, now - known.logged_at)
        if known is None and len(self._kinds) >= MAX_KINDS:
            del self._kinds[min(self._kinds, key=lambda name: self._kinds[name].logged_at)]
        self._kinds[kind] = _Kind(now)
        self._logger.log(level, message, *args, exc_info=exc_info)
