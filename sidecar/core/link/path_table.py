"""Finds one link's paths by what their datagrams say and by what the engine says; the link's parts share it."""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING

from plr.protos.base.token_bucket import TokenBucket
from plr.protos.model.ids import Role
from plr.sidecar.core.base.values import PathId, PathState
from plr.sidecar.core.link.memory import LinkMemory
from plr.sidecar.core.link.pinging import Pings
from plr.sidecar.core.path.congestion.choice import CONTROLLERS
from plr.sidecar.core.path.key_exchange import EXCHANGES_AT_ONCE, EXCHANGES_PER_S
from plr.sidecar.core.path.keys import make_path_keys
from plr.sidecar.core.path.path import Path
from plr.sidecar.core.seam.stats import LinkStats
from plr.sidecar.core.wire.introduction import hello_id

if TYPE_CHECKING:
    import random
    from collections.abc import Sequence

    from plr.protos.model.ids import Address, InterfaceId, NodeName, SessionId
    from plr.sidecar.core.link.sender import LinkIdentity
    from plr.sidecar.core.path.key_exchange import KeyLimits
    from plr.sidecar.core.seam.links import LinkEvent, LinkPeer

MAX_PATHS_OF_A_PEER = 32
"""Paths of one peer, including those by which it introduces itself. A further introduction replaces a path that nothing
authentic followed; if there is none, it waits until the control plane names that path."""
NEW_PATHS = 64
"""Burst of paths that one peer may begin by introductions: all that it may have, and all of them again, ..."""
NEW_PATHS_PER_S = 8.0
"""... and their rate after that, as if it restarted each second with 8 interfaces. Each costs public-key work, some 0.3
ms: without this a member that introduces ever new interfaces would occupy a processor."""
HANGING_LINK_NUMBERS = 1 << 32
"""Packet numbers reserved for a link whose driver does not return, so that the next link never seals with the same."""
UNPROVEN_BYTES = 65_536
"""Burst that may go to all addresses together that a peer has never proven: some 60 introductions, ..."""
UNPROVEN_BYTES_PER_S = 1200.0
"""... and the rate after that: one introduction a second. Announcing or listing others' addresses gets no more than
this out of each link."""


class PathTable:
    """Paths, who may use them, and their events and counters."""

    __slots__ = (
        "_by_peer", "_exchanges", "_limits", "_make_control", "_memory", "_new_paths", "_rng", "_unproven", "by_hello",
        "by_session", "closing", "dirty", "events", "identity", "paths", "pings", "stats",
    )  # fmt: skip

    def __init__(
        self, identity: LinkIdentity, memory: LinkMemory, limits: KeyLimits, controller: str, rng: random.Random
    ) -> None:
        """Create the table; `controller` names the congestion controller of its paths."""
        self._memory = memory
        self._limits = limits
        self._make_control = CONTROLLERS[controller]
        self._rng = rng
        self._unproven: dict[NodeName, TokenBucket] = {}
        """Bytes that may go to addresses that each peer has never proven."""
        self._new_paths: dict[NodeName, TokenBucket] = {}
        """Paths that each peer may begin by introductions."""
        self._exchanges: dict[NodeName, TokenBucket] = {}
        """Key exchanges with each peer that are processed."""
        self.identity = identity
        self.stats = LinkStats(identity.interface)
        self.events: deque[LinkEvent] = deque()
        """For the engine, oldest first."""
        self.by_session: dict[SessionId, LinkPeer] = {}
        self.by_hello: dict[bytes, LinkPeer] = {}
        self.paths: dict[tuple[NodeName, InterfaceId], Path] = {}
        self._by_peer: dict[NodeName, list[Path]] = {}
        self.dirty: dict[PathId, Path] = {}
        """Paths that may have something to send, or a changed timer."""
        self.pings = Pings()
        self.closing = False

    @property
    def next_number(self) -> int:
        """A packet number that no path of this link has reached yet."""
        return max((self._memory.next_number, *(path.recovery.next_number for path in list(self.paths.values()))))

    def remember(self, *, hangs: bool) -> LinkMemory:
        """Return what the interface's next link must know; `hangs`: this link may yet seal a burst or two."""
        memory = LinkMemory(self.next_number + (HANGING_LINK_NUMBERS if hangs else 0))
        memory.keep_all(self._memory)
        for path in list(self.paths.values()):
            memory.keep(path.peer, path.session, path.remote_id, path.keys.copy())
        return memory

    def introduced(self, peer: LinkPeer, remote: InterfaceId, now: float) -> Path | None:
        """Return the path to the interface by which a known peer introduced itself; None if it has too many.

        The control plane may not know that interface: so a robot's new interface works before it does, and without it.
        """
        path = self.paths.get((peer.name, remote))
        if path is not None:
            return path
        if not self._may_begin_path(peer.name, now):
            self.stats.dropped["new_paths_too_often"] += 1
            return None
        others = self.to(peer.name)
        if len(others) >= MAX_PATHS_OF_A_PEER:
            # The peer, or a thief of its token for us, could fill the table with interfaces that do not exist.
            unproven = next((path for path in others if path.remote is None and not path.candidates), None)
            if unproven is None:
                self.stats.dropped["paths_full"] += 1
                return None
            self._drop(unproven)
        path = self._new_path(peer, remote, (), self.next_number, now)
        if path is not None:
            path.set_dormant(now, dormant=peer.dormant)
            self._enter(path)
        return path

    def _may_begin_path(self, peer: NodeName, now: float) -> bool:
        bucket = self._new_paths.get(peer)
        if bucket is None:
            bucket = self._new_paths[peer] = TokenBucket(rate=NEW_PATHS_PER_S, burst=NEW_PATHS, now=now)
        return bucket.take(now)

    def to(self, peer: NodeName) -> Sequence[Path]:
        """Return the paths to one peer."""
        return self._by_peer.get(peer, ())

    def is_home(self, peer: NodeName, source: Address) -> bool:
        """Return whether the peer is known to be at this address."""
        return any(source == path.remote or source in path.candidates for path in self.to(peer))

    def _enter(self, path: Path) -> None:
        self.paths[path.peer, path.remote_id] = path
        self._by_peer.setdefault(path.peer, []).append(path)

    def _new_path(
        self, peer: LinkPeer, remote: InterfaceId, addresses: tuple[Address, ...], first_number: int, now: float
    ) -> Path | None:
        """Return None for a forgotten session's path: what came over it once would count as new."""
        leads = self.identity.role is Role.ROBOT
        keys = self._memory.take(peer.name, peer.session, remote)
        if keys is None:
            if self._memory.forgot(peer.name, peer.incarnation):
                self.stats.dropped["forgotten_session"] += 1
                return None
            ours = self.identity.interface_id
            keys = make_path_keys(peer.keys, ours, remote, self._limits, now, peer.incarnation, leads=leads)
        path_id = PathId(self.identity.interface, peer.name, remote)
        if peer.name not in self._unproven:
            self._unproven[peer.name] = TokenBucket(rate=UNPROVEN_BYTES_PER_S, burst=UNPROVEN_BYTES, now=now)
        if peer.name not in self._exchanges:
            self._exchanges[peer.name] = TokenBucket(rate=EXCHANGES_PER_S, burst=EXCHANGES_AT_ONCE, now=now)
        return Path(
            path_id,
            peer.session,
            keys,
            addresses,
            first_number,
            now,
            self._rng,
            self._unproven[peer.name],
            self._exchanges[peer.name],
            self._make_control,
            leads=leads,
        )

    def way_changed(self, now: float) -> None:
        """Refill the budgets, since our side of all paths changed: unreachable peers may be reachable now."""
        for bucket in self._unproven.values():
            bucket.fill(now)

    def _drop(self, path: Path) -> None:
        del self.paths[path.peer, path.remote_id]
        self._by_peer[path.peer].remove(path)
        self.dirty.pop(path.id, None)
        self._forget(path)

    def _forget(self, path: Path) -> None:
        # It may come back with the same keys: no number that it sealed with may be reused.
        self._memory.next_number = max(self._memory.next_number, path.recovery.next_number)
        self._memory.keep(path.peer, path.session, path.remote_id, path.keys)

    def owe(self, path: Path, encoded: bytes, by: float = 0.0) -> None:
        """Queue an encoded control frame for the path's next datagram, which leaves by `by` (s)."""
        if not path.owed.add(encoded, by):
            self.stats.dropped["pending_frames_full"] += 1
            return
        self.dirty[path.id] = path

    def owe_finished(self, path: Path, number: int, by: float = 0.0) -> None:
        """Queue FINISHED for the peer's message with this number, as `owe` does."""
        # A sender that hears nothing asks again (`Outbox.ask_again`).
        if not path.owed.add_finished(number, by):
            self.stats.dropped["pending_frames_full"] += 1
            return
        self.dirty[path.id] = path

    def set_peers(self, peers: tuple[LinkPeer, ...], now: float) -> list[Path]:
        """Keep the paths to these peers and begin new ones; return those that ended."""
        before = self.paths.copy()
        # A peer that comes back may remember our old packet numbers under the same session: never reuse one.
        first_number = self._memory.next_number = self.next_number
        self.by_session = {peer.session: peer for peer in peers}
        self.by_hello = {hello_id(peer.token): peer for peer in peers}
        self.paths.clear()
        self._by_peer.clear()
        for peer in peers:
            self._memory.begin_era(peer.name, peer.era)
            crowd = sum(len(addresses) for _, addresses in peer.addresses)
            for remote, addresses in peer.addresses:
                path = before.pop((peer.name, remote), None)
                if path is None or path.session != peer.session:
                    if path is not None:
                        before[peer.name, remote] = path
                    path = self._new_path(peer, remote, addresses, first_number, now)
                    if path is None:
                        continue
                    self.dirty[path.id] = path
                path.announced(addresses, crowd)
                if path.probing.dormant is not peer.dormant:
                    path.set_dormant(now, dormant=peer.dormant)
                    self.dirty[path.id] = path
                self._enter(path)
        for key, path in list(before.items()):
            known = self.by_session.get(path.session)
            if known is None or key in self.paths:
                continue
            # It proves itself, or is about to, whether the control plane's view is older or newer than what happened
            # here. A peer that would have to begin again with each view could not come back while views keep changing.
            begins = path.introductions.awaits_proof(now) and len(self.to(path.peer)) < MAX_PATHS_OF_A_PEER
            if path.state is not PathState.DOWN or begins:
                path.set_dormant(now, dormant=known.dormant)
                self._enter(before.pop(key))
        for path in before.values():
            self._forget(path)
        names = {peer.name for peer in peers}
        for buckets in (self._unproven, self._exchanges, self._new_paths):
            # A peer that leaves and returns keeps its budget as it was: only full budgets are forgotten.
            for name in [name for name, one in buckets.items() if name not in names and one.is_full(now)]:
                del buckets[name]
        return list(before.values())
