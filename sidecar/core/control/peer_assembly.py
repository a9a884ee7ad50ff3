"""Makes whole sets of what the control stream says of the peers: of changes, and of sets in several messages."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

from protos.model.ids import Version
from protos.model.members import MAX_PEERS, PeerSet
from protos.model.peer_changes import put_upon


class PeerAssembly:
    """The peers of one sidecar, put together; `peers` is the set in force, None if there is none, or none is known."""

    def __init__(self, peers: PeerSet | None) -> None:
        self._version = Version(0) if peers is None else peers.version
        self._held = {} if peers is None else {peer.name: peer for peer in peers.peers}
        self._begun: PeerSet | None = None
        """The messages so far of a set of which more is to come."""
        self._left_out: int | None = None
        """The nonce of a set of which a message was refused: what still comes of it is no set."""

    def begin_stream(self) -> None:
        """What was begun on the stream before does not go on."""
        self._begun = None
        self._left_out = None

    def leave_out(self, nonce: int) -> None:
        """A message of this set could not be read: the set is refused."""
        self._begun = None
        self._left_out = nonce

    def take(self, message: PeerSet) -> PeerSet | None:
        """Take a message; returns what all messages of its set say together, None until the last one is here.

        A set that is too large is returned as it is so far: `whole` refuses it.
        """
        if message.nonce == self._left_out:
            return None
        begun, self._begun = self._begun, None
        # Another set instead: the control plane has dropped the one it had begun.
        if begun is not None and _set_of(begun) == _set_of(message):
            message = replace(message, peers=(*begun.peers, *message.peers), removed=(*begun.removed, *message.removed))
        if len(message.peers) > MAX_PEERS or len(message.removed) > MAX_PEERS:
            self._left_out = message.nonce
            return message
        if message.more:
            self._begun = message
            return None
        return message

    def is_upon(self, said: PeerSet) -> bool:
        """Whether this is a whole set, or changes upon the one in force."""
        return said.base in (0, self._version)

    def whole(self, said: PeerSet) -> PeerSet | str:
        """Return the whole set that this leads to, or why there is none.

        A set, whatever number of messages it comes in, names nobody twice: neither as a peer, nor as removed, nor as
        both.
        """
        if len(said.peers) > MAX_PEERS or len(said.removed) > MAX_PEERS:
            return f"more than {MAX_PEERS} peers"
        names = Counter([*(peer.name for peer in said.peers), *(gone.name for gone in said.removed)])
        if len(names) < len(said.peers) + len(said.removed):
            (name, _), *_ = names.most_common(1)
            return f"{name} stands in it twice"
        if not said.base:
            return said
        if said.base != self._version:
            return f"these are changes upon version {said.base}; in force is {self._version}"
        whole = put_upon(self._held, said)
        return whole if len(whole.peers) <= MAX_PEERS else f"more than {MAX_PEERS} peers"

    def in_force(self, whole: PeerSet) -> None:
        """This set is what changes are upon from now on."""
        self._version = whole.version
        self._held = {peer.name: peer for peer in whole.peers}


def _set_of(message: PeerSet) -> tuple[Version, int, Version]:
    return message.version, message.nonce, message.base
