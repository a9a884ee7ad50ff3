"""Limits what extra copies may cost on an interface, by the configuration."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Budget:
    """The limits of the interfaces whose name matches `pattern` (exact or glob); each interface has its own."""

    pattern: str
    extra_load: float | None = None
    """Bytes of extra copies for each byte of requests answered in time; None: no such limit."""
    extra_bytes_a_day: int | None = None
    """Bytes of extra copies in 24 hours, counted from the first one; None: no such limit."""

    @property
    def limits(self) -> bool:
        """Whether there is any limit."""
        return self.extra_load is not None or self.extra_bytes_a_day is not None
