"""Assembles whole sets of peers from the control stream's changes and from sets in several messages."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

from plr.protos.model.ids import Version
from plr.protos.model.members import MAX_PEERS, PeerSet
from plr.protos.model.peer_changes import put_upon


class PeerAssembly:
    """Assembles the peers of one sidecar; `peers` is the set in force, None if there is none or none is known."""

    def __init__(self, peers: PeerSet | None) -> None:
        self._version = Version(0) if peers is None else peers.version
        self._held = {} if peers is None else {peer.name: peer for peer in peers.peers}
        self._begun: PeerSet | None = None
        """The messages so far of an incomplete set."""
        self._left_out: int | None = None
        """The nonce of a set of which a message was refused: its further messages are ignored."""

    def begin_stream(self) -> None:
        """Drop the set begun on the stream before: it does not go on."""
        self._begun = None
        self._left_out = None

    def leave_out(self, nonce: int) -> None:
        """Refuse a set of which a message could not be read."""
        self._begun = None
        self._left_out = nonce

    def take(self, message: PeerSet) -> PeerSet | None:
        """Take a message; return all messages of its set merged, None until the last one is here.

        A set that is too large is returned as far as it has come: `whole` refuses it.
        """
        if message.nonce == self._left_out:
            return None
        begun, self._begun = self._begun, None
        # Otherwise it belongs to another set: the control plane has dropped the one it had begun.
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
        """Return whether this is a whole set, or changes to the one in force."""
        return said.base in (0, self._version)

    def whole(self, said: PeerSet) -> PeerSet | str:
        """Return the whole set that this results in, or why there is none.

        A set, in however many messages it comes, names no peer twice: not as a peer, not as removed, not as both.
        """
        if len(said.peers) > MAX_PEERS or len(said.removed) > MAX_PEERS:
            return f"more than {MAX_PEERS} peers"
        names = Counter([*(peer.name for peer in said.peers), *(gone.name for gone in said.removed)])
        if len(names) < len(said.peers) + len(said.removed):
            (name, _), *_ = names.most_common(1)
            return f"{name} appears twice in it"
        if not said.base:
            return said
        if said.base != self._version:
            return f"these changes are based on version {said.base}, but version {self._version} is in force"
        whole = put_upon(self._held, said)
        return whole if len(whole.peers) <= MAX_PEERS else f"more than {MAX_PEERS} peers"

    def in_force(self, whole: PeerSet) -> None:
        """Make this set the base of changes from now on."""
        self._version = whole.version
        self._held = {peer.name: peer for peer in whole.peers}


def _set_of(message: PeerSet) -> tuple[Version, int, Version]:
    return message.version, message.nonce, message.base
