"""What a CA has issued and revoked."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from protos.identity import IdentityRole
    from protos.model import NodeName


@dataclass(frozen=True, slots=True)
class Entry:
    """One certificate; times in seconds since 1970."""

    name: NodeName
    role: IdentityRole
    serial: int
    not_before: float
    not_after: float
    revoked_at: float | None = None
    reason: str = ""

    def in_force(self, now_wall: float) -> bool:
        """Whether the certificate is neither revoked nor past its time."""
        return self.revoked_at is None and now_wall <= self.not_after
