"""Determines which versions of the protocol a program speaks, and which one two programs use with each other.

Each program speaks the newest version that it knows, N, and also N-1, so that a fleet can be upgraded in any order.
docs/develop/protocol.md says what may be added without a new version, as programs that do not know it ignore it.
"""

from __future__ import annotations

from typing import NamedTuple

from plr.protos.model.ids import OLDEST_PROTOCOL_VERSION, PROTOCOL_VERSION


class Spoken(NamedTuple):
    """Versions from `oldest` to `newest`, both included."""

    oldest: int
    newest: int

    def common(self, other: Spoken) -> int | None:
        """Return the newest version that both speak; None if there is none."""
        newest = min(self.newest, other.newest)
        return newest if newest >= max(self.oldest, other.oldest) else None

    def __str__(self) -> str:
        return str(self.newest) if self.oldest == self.newest else f"{self.oldest} to {self.newest}"


OURS = Spoken(OLDEST_PROTOCOL_VERSION, PROTOCOL_VERSION)


def refusal(sidecar: Spoken, ours: Spoken = OURS) -> str | None:
    """Return why a control plane that speaks `ours` cannot talk to a sidecar, and what to do; None if it can."""
    if sidecar.common(ours) is not None:
        return None
    behind = "sidecar" if sidecar.newest < ours.oldest else "control plane"
    return f"the sidecar speaks protocol version {sidecar}, this control plane {ours}: upgrade the {behind}"
