"""What an interface's link knows of paths that are no more: their keys' phases, and the packet numbers that came.

A session may come back after minutes or hours with the same keys, so what came once must never count as new
(replayed requests would run again) and a key's phase must not begin anew (the peer would not be understood). Each peer
has a share, so none can flush what is known of another. Where a share is full the oldest session of that peer goes,
and from then on its sessions up to that one are refused: nothing of a forgotten session begins anew.
"""

from __future__ import annotations

from collections import OrderedDict
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from protos.model.ids import InterfaceId, NodeName, SessionId
    from sidecar.core.path.keys import PathKeys

MAX_PATHS_OF_A_PEER = 256
"""As many as one session can have to one of our interfaces: an interface's number has 8 bits. So a share never forgets
the session in use."""
MAX_PATHS = 16_384
"""Beyond it, whoever has the most forgets the oldest session's."""
MAX_FORGOTTEN_PEERS = 65_536
"""Peers of which a session was forgotten."""


class LinkMemory:
    """What an interface's next link, in the same run of the sidecar, must know of the one before."""

    __slots__ = ("_count", "_eras", "_forgotten", "_paths", "next_number")

    def __init__(self, next_number: int = 0) -> None:
        self.next_number = next_number
        """No path used this packet number or a later one."""
        self._paths: dict[NodeName, dict[tuple[SessionId, InterfaceId], PathKeys]] = {}
        self._count = 0
        self._forgotten: OrderedDict[NodeName, int] = OrderedDict()
        """The newest incarnation of each peer of which a path was forgotten."""
        self._eras: dict[NodeName, int] = {}

    def __len__(self) -> int:
        return self._count

    def keep_all(self, other: LinkMemory) -> None:
        """Take over what another one keeps."""
        for peer, era in list(other._eras.items()):
            self.begin_era(peer, era)
        for peer, incarnation in list(other._forgotten.items()):
            self._forget_up_to(peer, incarnation)
        for peer, paths in list(other._paths.items()):
            for (session, remote), keys in list(paths.items()):
                self.keep(peer, session, remote, keys.copy())

    def begin_era(self, peer: NodeName, era: int) -> None:
        """What is known of a peer is of one that was revoked, if its era is another one.

        That one may have used the largest incarnations there are, and none of its sessions can come back.
        """
        if era == self._eras.get(peer, 0):
            return
        self._eras[peer] = era
        self._count -= len(self._paths.pop(peer, ()))
        self._forgotten.pop(peer, None)

    def keep(self, peer: NodeName, session: SessionId, remote: InterfaceId, keys: PathKeys) -> None:
        """The path with these keys, to this interface of a peer's session, is no more."""
        keys.opening.forget_previous()
        if keys.received.largest < 0 and not keys.has_answered:
            # Nothing of the peer was ever opened, so its window is empty, and both ends' keys are those of the
            # beginning. Who introduces interfaces that do not exist, without its session's key, leaves nothing here.
            return
        paths = self._paths.setdefault(peer, {})
        self._count += (session, remote) not in paths
        paths[session, remote] = keys
        if len(paths) > MAX_PATHS_OF_A_PEER:
            self._evict(peer)
        elif self._count > MAX_PATHS:
            self._evict(max(self._paths, key=lambda name: len(self._paths[name])))

    def take(self, peer: NodeName, session: SessionId, remote: InterfaceId) -> PathKeys | None:
        """Return what was kept of a path that is there again."""
        paths = self._paths.get(peer, {})
        keys = paths.pop((session, remote), None)
        if keys is not None:
            self._count -= 1
            if not paths:
                del self._paths[peer]
        return keys

    def forgot(self, peer: NodeName, incarnation: int) -> bool:
        """Whether a path of this session that is not kept may be forgotten: then it must not begin anew."""
        return incarnation <= self._forgotten.get(peer, -1)

    def _evict(self, peer: NodeName) -> None:
        paths = self._paths[peer]
        oldest = min(paths, key=lambda path: paths[path].incarnation)
        self._forget_up_to(peer, paths.pop(oldest).incarnation)
        self._count -= 1

    def _forget_up_to(self, peer: NodeName, incarnation: int) -> None:
        self._forgotten[peer] = max(incarnation, self._forgotten.get(peer, -1))
        self._forgotten.move_to_end(peer)
        if len(self._forgotten) > MAX_FORGOTTEN_PEERS:
            self._forgotten.popitem(last=False)
