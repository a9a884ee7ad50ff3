"""Compares figures with targets. A figure that was not measured has no verdict: it is neither met nor missed."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Mapping

    from bench.reporting.tables import Figure

VERDICTS = {True: "met", False: "missed", None: "not measured"}


@dataclass(frozen=True, slots=True)
class Target:
    """The bounds of a figure, both inclusive."""

    key: str
    meaning: str
    at_least: float | None = None
    at_most: float | None = None
    or_key: str | None = None
    """Another figure that also meets the target when it is at least `or_at_least`."""
    or_at_least: float = 0.0

    def met(self, figures: Mapping[str, Figure]) -> bool | None:
        """Return whether the target is met; None if it was not measured."""
        value = figures.get(self.key)
        if value is None:
            return None
        other = figures.get(self.or_key) if self.or_key else None
        if other is not None and other >= self.or_at_least:
            return True
        return (self.at_least is None or value >= self.at_least) and (self.at_most is None or value <= self.at_most)

    def verdict(self, figures: Mapping[str, Figure]) -> str:
        """Return `met` in words."""
        return VERDICTS[self.met(figures)]

    @property
    def wanted(self) -> str:
        """The bounds as text."""
        bounds = []
        if self.at_least is not None:
            bounds.append(f"≥ {self.at_least:g}")
        if self.at_most is not None:
            bounds.append(f"≤ {self.at_most:g}")
        text = " and ".join(bounds)
        return f"{text}, or {self.or_key} ≥ {self.or_at_least:g}" if self.or_key else text
