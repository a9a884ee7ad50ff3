"""Remembers why the control plane took peers out of the view, for people who look at this node."""

from __future__ import annotations

from collections import OrderedDict
from typing import TYPE_CHECKING, NamedTuple

from plr.protos.model.members import RemovalReason

if TYPE_CHECKING:
    from collections import Counter
    from collections.abc import Collection, Iterable

    from plr.protos.model.ids import NodeName
    from plr.protos.model.members import PeerSet

WHY_REMOVED = {
    RemovalReason.LEASE_EXPIRED: "its lease expired",
    RemovalReason.LEFT: "it was stopped",
    RemovalReason.REVOKED: "its certificate was revoked",
    RemovalReason.FORBIDDEN: "the access policy leaves the two nothing to do with each other",
    RemovalReason.EXPIRED: "its certificate ended",
}
"""Each reason for people."""
MAX_REMOVALS = 1024
"""Removed peers that are remembered, one entry for each name; the one removed first is forgotten."""


class Removal(NamedTuple):
    """The end of a peer's place in the view."""

    reason: RemovalReason | None
    """None: the view just does not list it any more."""
    at: float
    """When it was removed (monotonic, s)."""
    dormant_at: float | None = None
    """When it last became dormant (monotonic, s); None: not since it was removed."""


class Removals:
    """Peers that the view listed and does not list now."""

    def __init__(self, dropped: Counter[str]) -> None:
        self._dropped = dropped
        self._removals: OrderedDict[NodeName, Removal] = OrderedDict()

    def follow(self, peer_set: PeerSet, held: Collection[NodeName], now: float) -> None:
        """Follow a view that is in force; `held` are the peers, refused ones included, that the view before it listed.

        Others were removed before: a removal that is forgotten would begin again with the time of this view.
        """
        for peer in peer_set.peers:
            self._removals.pop(peer.name, None)
        listed = {peer.name for peer in peer_set.peers}
        reasons = {removed.name: removed.reason for removed in peer_set.removed}
        for name in held:
            if name not in listed and name not in self._removals:
                self._removals[name] = Removal(reasons.get(name), now)
        for name, reason in reasons.items():
            known = self._removals.get(name)
            if known is not None and known.reason is not reason:
                self._removals[name] = known._replace(reason=reason, at=now)
                self._removals.move_to_end(name)
        while len(self._removals) > MAX_REMOVALS:
            self._removals.popitem(last=False)
            self._dropped["removal_forgotten"] += 1

    def note_dormant(self, names: Iterable[NodeName], now: float) -> None:
        """Note that these removed peers became dormant."""
        for name in names:
            removal = self._removals.get(name)
            if removal is not None:
                self._removals[name] = removal._replace(dormant_at=now)

    def latest(self) -> list[tuple[NodeName, Removal]]:
        """Return the removals, the last one first."""
        return list(reversed(self._removals.items()))
