"""Remembers why the control plane took peers out of the view, for people who look at this node."""

from __future__ import annotations

from collections import OrderedDict
from typing import TYPE_CHECKING, NamedTuple

from plr.protos.model.members import RemovalReason

if TYPE_CHECKING:
    from collections import Counter
    from collections.abc import Collection, Container, Iterable

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
"""Removed peers that are remembered, one entry for each name; the one removed first is forgotten. Those that are kept
all the same (`peers.py`) are always remembered: people ask about them, and they are at most `MAX_PEERS`."""


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

    def follow(
        self,
        peer_set: PeerSet,
        held: Collection[NodeName],
        now: float,
        *,
        kept: Container[NodeName] = (),
        ended_by_policy: Iterable[NodeName] = (),
    ) -> None:
        """Follow a view that is in force; `held` are the peers, refused ones included, that the view before it listed.

        Others were removed before: a removal that is forgotten would begin again with the time of this view. `kept` are
        those that are kept though it does not list them, `ended_by_policy` those that were kept, and are not, since the
        access policy is another one now.
        """
        for peer in peer_set.peers:
            self._removals.pop(peer.name, None)
        listed = {peer.name for peer in peer_set.peers}
        reasons = {removed.name: removed.reason for removed in peer_set.removed}
        reasons.update(dict.fromkeys(ended_by_policy, RemovalReason.FORBIDDEN))
        for name in held:
            if name not in listed and name not in self._removals:
                self._removals[name] = Removal(reasons.get(name), now)
        for name, reason in reasons.items():
            known = self._removals.get(name)
            # "Lease expired" is what the control plane says if it knows no better.
            lighter = reason is RemovalReason.LEASE_EXPIRED and known is not None and known.reason is not None
            if known is not None and known.reason is not reason and not lighter:
                self._removals[name] = known._replace(reason=reason, at=now)
                self._removals.move_to_end(name)
        self._make_room(kept)

    def _make_room(self, kept: Container[NodeName]) -> None:
        if len(self._removals) <= MAX_REMOVALS:
            return
        gone = [name for name in self._removals if name not in kept]
        for name in gone[: max(0, len(gone) - MAX_REMOVALS)]:
            del self._removals[name]
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
