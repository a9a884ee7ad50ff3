"""Holds the peers of one sidecar with the tokens by which they introduce themselves to it, and to nobody else.

What many are told alike is made once (`views.py`), with the peers' own tokens, which nobody is ever told. The derived
ones are made when the set is read, that is written to its stream: sets of a large fleet hold some 100,000 pairs, and
one that a newer one supersedes costs nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, overload

from plr.protos.trust.pair_token import pair_token

if TYPE_CHECKING:
    from collections.abc import Iterator

    from plr.protos.model.ids import NodeName, Role
    from plr.protos.model.members import Peer


class ToldPeers(Sequence["Peer"]):
    """What the sidecar of this name and role is sent about `peers`, which have their own tokens."""

    __slots__ = ("_name", "_peers", "_role")

    def __init__(self, peers: tuple[Peer, ...], name: NodeName, role: Role) -> None:
        self._peers = peers
        self._name = name
        self._role = role

    def __len__(self) -> int:
        return len(self._peers)

    def __iter__(self) -> Iterator[Peer]:
        return map(self._told, self._peers)

    def names(self) -> Iterator[NodeName]:
        """Return their names, without making any token."""
        return (peer.name for peer in self._peers)

    def with_tokens(self) -> Iterator[tuple[Peer, bytes]]:
        """Yield each peer as all are told it, except for its token, and the token that this sidecar is told."""
        for peer in self._peers:
            yield peer, pair_token(peer.token, self._name, self._role)

    @overload
    def __getitem__(self, index: int) -> Peer: ...
    @overload
    def __getitem__(self, index: slice) -> Sequence[Peer]: ...
    def __getitem__(self, index: int | slice) -> Peer | Sequence[Peer]:
        if isinstance(index, slice):
            return ToldPeers(self._peers[index], self._name, self._role)
        return self._told(self._peers[index])

    def __eq__(self, other: object) -> bool:
        return tuple(self) == tuple(other) if isinstance(other, Sequence) else NotImplemented

    def __hash__(self) -> int:
        return hash(tuple(self))

    def _told(self, peer: Peer) -> Peer:
        return peer.with_token(pair_token(peer.token, self._name, self._role))
