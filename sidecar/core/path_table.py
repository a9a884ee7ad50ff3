"""The paths of one link, by what their datagrams say and by what the engine says; shared by the link's parts."""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING

from protos.model import InterfaceId, SessionId
from sidecar.core import frame
from sidecar.core.path_id import PathId, PathState
from sidecar.core.paths import Path
from sidecar.core.stats import LinkStats

if TYPE_CHECKING:
    from protos.model import NodeName
    from sidecar.core.datagrams import LinkIdentity
    from sidecar.core.frame import Header
    from sidecar.core.link_events import LinkEvent, LinkPeer

MAX_PENDING_FRAMES = 256
"""Control frames waiting on one path; a peer that makes us owe more is not honest."""
MAX_PATHS_OF_A_PEER = 32
"""Of those that a peer introduces itself by; further ones wait for the control plane's word."""


class PathTable:
    """Paths, who may use them, and what came of them."""

    __slots__ = ("by_session", "by_token", "closing", "dirty", "events", "first_number", "identity", "paths", "stats")

    def __init__(self, identity: LinkIdentity, first_number: int) -> None:
        self.identity = identity
        self.stats = LinkStats(identity.interface)
        self.events: deque[LinkEvent] = deque()
        """For the engine, oldest first."""
        self.by_session: dict[SessionId, LinkPeer] = {}
        self.by_token: dict[bytes, LinkPeer] = {}
        self.paths: dict[tuple[NodeName, InterfaceId], Path] = {}
        self.dirty: dict[PathId, Path] = {}
        """Paths that may have something to send, or another timer than before."""
        self.closing = False
        self.first_number = first_number

    @property
    def next_number(self) -> int:
        """No path of this link used this packet number or a later one."""
        return max((self.first_number, *(path.recovery.next_number for path in self.paths.values())))

    def of_head(self, head: int, session: int) -> Path | None:
        """Return the path that a datagram of this clear head (its first four bytes) and session came over."""
        peer = self.by_session.get(SessionId(session))
        if peer is None:
            return None
        sender = InterfaceId(head >> 8 & 0xFF)
        if head != frame.clear_head(sender, self.identity.interface_id):
            return None
        return self.paths.get((peer.name, sender))

    def introduce(self, peer: LinkPeer, header: Header, first: frame.Frame, now: float) -> Path | None:
        """A known peer speaks from an interface that the control plane has not told of (yet): believed with its token.

        So a robot's new interface works before, and without, the control plane.
        """
        if not isinstance(first, frame.Hello) or first.token != peer.token:
            return None
        if sum(name == peer.name for name, _ in self.paths) >= MAX_PATHS_OF_A_PEER:
            self.stats.dropped["paths_full"] += 1
            return None
        path_id = PathId(self.identity.interface, peer.name, header.sender_interface)
        path = self.paths[peer.name, header.sender_interface] = Path(path_id, peer.session, (), self.next_number, now)
        return path

    def owe(self, path: Path, encoded: bytes, by: float = 0.0) -> None:
        """Queue an encoded control frame for the path's next datagram, which leaves at `by` (s) at the latest."""
        if len(path.pending) >= MAX_PENDING_FRAMES:
            self.stats.dropped["pending_frames_full"] += 1
            return
        path.pending.append(encoded)
        path.pending_by = min(path.pending_by, by)
        self.dirty[path.id] = path

    def set_peers(self, peers: tuple[LinkPeer, ...], now: float) -> list[Path]:
        """Keep the paths to these peers and begin new ones; returns those that are no more."""
        before = self.paths.copy()
        # A peer that comes back may remember our old packet numbers under the same session: never use one again.
        first_number = self.first_number = self.next_number
        self.by_session = {peer.session: peer for peer in peers}
        self.by_token = {peer.token: peer for peer in peers}
        self.paths.clear()
        for peer in peers:
            for remote, addresses in peer.addresses:
                path = before.pop((peer.name, remote), None)
                if path is not None and path.session == peer.session:
                    path.candidates = addresses
                else:
                    if path is not None:
                        before[peer.name, remote] = path
                    path_id = PathId(self.identity.interface, peer.name, remote)
                    path = Path(path_id, peer.session, addresses, first_number, now)
                self.paths[peer.name, remote] = path
                self.dirty[path.id] = path
        for key, path in list(before.items()):
            known = self.by_session.get(path.session)
            if path.state is not PathState.DOWN and known is not None and key not in self.paths:
                # It proves itself, whatever the control plane's view says: older or newer than what happened here.
                self.paths[key] = before.pop(key)
        return list(before.values())
