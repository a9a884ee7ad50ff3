"""Keeps the peers that the control plane lost and no path reaches, so that they are answered when they talk again.

A dormant peer costs its entry here and in the links: a cloud sends it nothing, a robot asks ever less often
(`MAX_DORMANT_PROBE_S` in `probing.py`). Only peers that the view listed, and whose credentials were judged good, get
here, each with one entry.
"""

from __future__ import annotations

from collections import OrderedDict
from typing import TYPE_CHECKING, NamedTuple

from plr.protos.model.ids import Role
from plr.protos.model.members import MAX_PEERS

if TYPE_CHECKING:
    from collections import Counter
    from collections.abc import Callable

    from plr.protos.model.ids import NodeName, SessionId
    from plr.protos.model.members import Peer
    from plr.sidecar.core.crypto.key_schedule import PairKeys

MAX_DORMANT_SERVERS = 64
"""Dormant servers of a robot, which asks each of them now and then over links that may be metered. A cloud asks nobody:
its dormant robots and its other peers together are at most `MAX_PEERS`."""


class Dormant(NamedTuple):
    """A dormant peer, and the keys shared with it."""

    peer: Peer
    keys: PairKeys


class DormantPeers:
    """Dormant peers by name, the one dormant for longest first."""

    def __init__(self, role: Role, dropped: Counter[str]) -> None:
        """Create the table of a sidecar of this role."""
        self._most = MAX_DORMANT_SERVERS if role is Role.ROBOT else MAX_PEERS
        self._dropped = dropped
        self._peers: OrderedDict[NodeName, Dormant] = OrderedDict()
        self._forgotten: dict[NodeName, SessionId] = {}
        """Those forgotten since `take_forgotten`, which the engine calls after each change."""
        self._ended: OrderedDict[NodeName, Peer] = OrderedDict()

    def __contains__(self, name: object) -> bool:
        return name in self._peers

    def all(self) -> list[Dormant]:
        """Return all of them."""
        return list(self._peers.values())

    def get(self, name: NodeName) -> Dormant | None:
        """Return a dormant peer by name."""
        return self._peers.get(name)

    def put(self, dormant: Dormant) -> None:
        """Add a peer; or replace what is known of it, which keeps its place in the order."""
        self._peers[dormant.peer.name] = dormant

    def take(self, name: NodeName) -> Dormant | None:
        """Remove and return a peer; None if it is not dormant."""
        return self._peers.pop(name, None)

    def has_session(self, session: SessionId) -> bool:
        """Return whether this is the session of a dormant peer, or of one set aside."""
        held = (*(dormant.peer for dormant in self._peers.values()), *self._ended.values())
        return any(peer.session == session for peer in held)

    def drop(self, over: Callable[[Peer], bool]) -> None:
        """Forget those that may not come back."""
        for dormant in self.all():
            if over(dormant.peer):
                self.forget(dormant.peer.name)
        for name, peer in list(self._ended.items()):
            if over(peer):
                del self._ended[name]

    def forget(self, name: NodeName) -> None:
        """Forget a dormant peer."""
        self._forgotten[name] = self._peers.pop(name).peer.session

    def set_aside(self, peer: Peer) -> None:
        """Remember a peer that is none any more because of its certificate's time, by a clock that may be wrong.

        Links do not know it. Its certificate may be good again when somebody sets the clock.
        """
        self._ended[peer.name] = peer
        self._ended.move_to_end(peer.name)
        if len(self._ended) > self._most:
            self._ended.popitem(last=False)
            self._dropped["dormant_full"] += 1

    def aside(self) -> list[Peer]:
        """Return those set aside."""
        return list(self._ended.values())

    def take_aside(self, peer: Peer) -> bool:
        """Set a peer aside no longer; return False if it was not."""
        if self._ended.get(peer.name) is not peer:
            return False
        del self._ended[peer.name]
        return True

    def make_room(self, awake: int) -> None:
        """Forget those dormant for longest until the rest fit beside `awake` other peers."""
        while len(self._peers) > max(0, min(self._most, MAX_PEERS - awake)):
            self.forget(next(iter(self._peers)))
            self._dropped["dormant_full"] += 1

    def take_forgotten(self) -> dict[NodeName, SessionId]:
        """Return those forgotten since the last call, and their sessions."""
        forgotten, self._forgotten = self._forgotten, {}
        return forgotten
