"""Limits how often credentials in introductions are verified: each look is public-key work, some 0.3 ms.

A node that knows a peer's token for us, as the control plane does, can send as many credentials as it likes. So looks
are counted separately from restarts: forgeries cost looks, and the genuine credential, which is repeated several times
a second, gets its turn among them. Credentials from a known address of the peer are counted separately from the rest: a
forger must forge that address as well.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from plr.protos.base.token_bucket import TokenBucket

if TYPE_CHECKING:
    from collections.abc import Container

    from plr.protos.model.ids import NodeName

LOOKS_PER_S = 10.0
"""Looks for each peer. A hundred forgeries a second delay a restart by some ten tries, 2.5 s in the median."""
LOOKS_AT_ONCE = 10.0
ALL_LOOKS_PER_S = 200.0
"""Looks for all peers together: 6 % of a processor."""
ALL_LOOKS_AT_ONCE = 400.0
"""Peers that may restart, or introduce themselves with renewed certificates, at once."""


class VerificationBudget:
    """Tokens for looks at credentials."""

    def __init__(self) -> None:
        self._all: TokenBucket | None = None
        self._of_peer: dict[tuple[NodeName, bool], TokenBucket] = {}
        self._at = 0.0
        """When the last look was asked for."""

    def take(self, peer: NodeName, now: float, *, at_home: bool) -> bool:
        """Return whether this peer's credential may be verified now; `at_home`: it came from a known address of it."""
        self._at = now
        if self._all is None:
            self._all = TokenBucket(rate=ALL_LOOKS_PER_S, burst=ALL_LOOKS_AT_ONCE, now=now)
        own = self._of_peer.get((peer, at_home))
        if own is None:
            own = self._of_peer[peer, at_home] = TokenBucket(rate=LOOKS_PER_S, burst=LOOKS_AT_ONCE, now=now)
        # The peer's own bucket first: a peer that has no looks left takes none from the others.
        return own.take(now) and self._all.take(now)

    def keep(self, peers: Container[NodeName]) -> None:
        """Forget other peers once their buckets are full again, so that coming and going earns no new looks."""
        self._of_peer = {
            key: bucket for key, bucket in self._of_peer.items() if key[0] in peers or not bucket.is_full(self._at)
        }
