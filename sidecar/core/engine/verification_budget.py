"""How often a credential that came in an introduction is looked at: each look is public-key work, some 0.3 ms.

Whoever knows a peer's token for us, as the control plane does, can send as many credentials as it likes. So the looks
are counted, apart from how often a peer may restart: what is forged costs looks, and the genuine one, which comes again
several times a second, gets its turn among them. What comes from where the peer is known to be is counted apart from
the rest: whoever forges must forge that address as well.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from protos.base.token_bucket import TokenBucket

if TYPE_CHECKING:
    from collections.abc import Container

    from protos.model.ids import NodeName

LOOKS_PER_S = 10.0
"""For each peer. A hundred forgeries a second hold a restart up for some ten tries, 2.5 s in the median."""
LOOKS_AT_ONCE = 10.0
ALL_LOOKS_PER_S = 200.0
"""For all peers together: 6 % of a processor."""
ALL_LOOKS_AT_ONCE = 400.0
"""So many peers may restart at once, or introduce themselves with renewed certificates."""


class VerificationBudget:
    """Tokens for looks at credentials."""

    def __init__(self) -> None:
        self._all: TokenBucket | None = None
        self._of_peer: dict[tuple[NodeName, bool], TokenBucket] = {}
        self._at = 0.0
        """When the last credential was to be looked at."""

    def take(self, peer: NodeName, now: float, *, at_home: bool) -> bool:
        """Whether a credential of this peer may be looked at now; `at_home`: it comes from a known address of it."""
        self._at = now
        if self._all is None:
            self._all = TokenBucket(rate=ALL_LOOKS_PER_S, burst=ALL_LOOKS_AT_ONCE, now=now)
        own = self._of_peer.get((peer, at_home))
        if own is None:
            own = self._of_peer[peer, at_home] = TokenBucket(rate=LOOKS_PER_S, burst=LOOKS_AT_ONCE, now=now)
        # A peer's own first: one that has none left takes nothing from the others.
        return own.take(now) and self._all.take(now)

    def keep(self, peers: Container[NodeName]) -> None:
        """Forget all others, once they have all their looks again: who comes and goes gets no new ones by it."""
        self._of_peer = {
            key: bucket for key, bucket in self._of_peer.items() if key[0] in peers or not bucket.is_full(self._at)
        }
