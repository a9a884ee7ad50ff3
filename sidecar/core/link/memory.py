"""Keeps what an interface's link knows of past paths: their keys' phases, and the packet numbers that came.

A session may come back after minutes or hours with the same keys. So a packet number that came once must never count as
new (replayed requests would run again), and a key's phase must not restart (the peer would not be understood). Each
peer has a share, so none can flush what is known of another. When a share is full, that peer's oldest session goes.
From then on its sessions up to that one are refused: no forgotten session restarts.
"""

from __future__ import annotations

from collections import OrderedDict
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from plr.protos.model.ids import InterfaceId, NodeName, SessionId
    from plr.sidecar.core.path.keys import PathKeys

MAX_REMEMBERED_PATHS_OF_PEER = 256
"""As many as one session can have to one of our interfaces, since an interface's number has 8 bits. So a share never
forgets the current session."""
MAX_REMEMBERED_PATHS = 16_384
"""Beyond it, the peer with the most paths loses its oldest session's."""
MAX_FORGOTTEN_PEERS = 65_536
"""Peers remembered as having a forgotten session."""


class LinkMemory:
    """What an interface's next link, in the same run of the sidecar, must know of the previous one."""

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
        """Take over what another memory keeps."""
        for peer, era in list(other._eras.items()):
            self.begin_era(peer, era)
        for peer, incarnation in list(other._forgotten.items()):
            self._forget_up_to(peer, incarnation)
        for peer, paths in list(other._paths.items()):
            for (session, remote), keys in list(paths.items()):
                self.keep(peer, session, remote, keys.copy())

    def begin_era(self, peer: NodeName, era: int) -> None:
        """Discard what is known of a peer if its era changed: that peer was revoked.

        It may have used the largest incarnations there are, and none of its sessions can come back.
        """
        if era == self._eras.get(peer, 0):
            return
        self._eras[peer] = era
        self._count -= len(self._paths.pop(peer, ()))
        self._forgotten.pop(peer, None)

    def keep(self, peer: NodeName, session: SessionId, remote: InterfaceId, keys: PathKeys) -> None:
        """Keep the keys of a past path to this interface of a peer's session."""
        keys.opening.forget_previous()
        if keys.received.largest < 0 and not keys.has_answered:
            # Nothing of the peer was ever opened, so its window is empty, and both ends have their initial keys. A
            # member that introduces interfaces that do not exist, without its session's key, leaves nothing here.
            return
        paths = self._paths.setdefault(peer, {})
        self._count += (session, remote) not in paths
        paths[session, remote] = keys
        if len(paths) > MAX_REMEMBERED_PATHS_OF_PEER:
            self._evict(peer)
        elif self._count > MAX_REMEMBERED_PATHS:
            self._evict(max(self._paths, key=lambda name: len(self._paths[name])))

    def take(self, peer: NodeName, session: SessionId, remote: InterfaceId) -> PathKeys | None:
        """Remove and return what was kept of a path that is back."""
        paths = self._paths.get(peer, {})
        keys = paths.pop((session, remote), None)
        if keys is not None:
            self._count -= 1
            if not paths:
                del self._paths[peer]
        return keys

    def forgot(self, peer: NodeName, incarnation: int) -> bool:
        """Return whether an unknown path of this session may be a forgotten one, which must not restart."""
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
