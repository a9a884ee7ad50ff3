"""Decides where peers may be looked for: at the newest addresses that each of them has signed itself.

The control plane relays them. What it adds, changes or replays is not used, so that it cannot aim a fleet at an address
of its choosing; the addresses that the peer signed before stay in use. They are remembered for longer than the peer is
known: taking it out of the view and putting it back brings no old ones into use. Addresses signed with a certificate
that has been revoked are forgotten when the view lists another run of the peer.
"""

from __future__ import annotations

from collections import Counter, OrderedDict
from typing import TYPE_CHECKING, NamedTuple

from plr.protos.base.errors import DecodeError
from plr.protos.model.members import MAX_CANDIDATES_OF_INTERFACE
from plr.protos.trust.identity import REVOKED, CertificateError

if TYPE_CHECKING:
    from plr.protos.model.ids import InterfaceId, NodeName
    from plr.protos.model.members import Candidate, Peer
    from plr.sidecar.core.crypto.session import OwnSession

MAX_ANNOUNCED_PEERS = 8192
"""Peers whose newest announcement is remembered; twice those of a view, so that the absent ones are forgotten."""


class _Announcement(NamedTuple):
    incarnation: int
    serial: int
    told: tuple[Candidate, ...]
    used: tuple[Candidate, ...]
    signed: bool
    by: Peer
    """The peer that announced it, with the credential of that run."""


class Announced:
    """The newest announcement of each peer."""

    def __init__(self, own: OwnSession, dropped: Counter[str]) -> None:
        self._own = own
        self._dropped = dropped
        self._newest: OrderedDict[NodeName, _Announcement] = OrderedDict()
        self.eras: Counter[NodeName] = Counter()
        """Times that a name got a new owner, after the certificate of the old one was revoked."""
        self.ignored: dict[NodeName, str] = {}
        """Why the last news of a peer's addresses is not used, for peers that are remembered or in the view."""

    def candidates_of(self, told: Peer) -> tuple[Candidate, ...]:
        """Return the addresses to use for a peer that the view now describes as `told`."""
        newest = self._newest.get(told.name)
        if newest is not None and newest.incarnation != told.incarnation and self._is_revoked(newest.by):
            # A thief may have signed with the largest incarnation there is.
            del self._newest[told.name]
            self.eras[told.name] += 1
            newest = None
        if newest is None or newest[:3] != (told.incarnation, told.candidates_serial, told.candidates):
            fault, newest = self._judge(told, newest)
        else:
            fault = ""
        if fault:
            self.ignored[told.name] = fault
        else:
            self.ignored.pop(told.name, None)
        if newest is None:
            return ()
        self._newest[told.name] = newest
        self._newest.move_to_end(told.name)
        if len(self._newest) > MAX_ANNOUNCED_PEERS:
            self._newest.popitem(last=False)
        return newest.used

    def _judge(self, told: Peer, newest: _Announcement | None) -> tuple[str, _Announcement | None]:
        """Return what is wrong with news of a peer's addresses (empty: nothing), and the announcement to use."""
        nothing_said = not told.candidates and not told.candidates_signature
        if newest is not None and newest.signed:
            if nothing_said:
                return "", newest  # it has a new run or certificate, with which it is about to sign them
            if (told.incarnation, told.candidates_serial) <= (newest.incarnation, newest.serial):
                self._dropped["old_candidates"] += 1
                return "they are older than its earlier announcement", newest
        try:
            signed = self._own.check_candidates(told)
        except DecodeError as error:
            if nothing_said:
                return "", newest
            self._dropped["bad_candidates"] += 1
            return str(error), newest
        used = _cut(told.candidates)
        if len(used) < len(told.candidates):
            self._dropped["candidates_full"] += len(told.candidates) - len(used)
        return "", _Announcement(told.incarnation, told.candidates_serial, told.candidates, used, signed, told)

    def _is_revoked(self, peer: Peer) -> bool:
        try:
            self._own.admit(peer)
        except DecodeError as error:
            return isinstance(error, CertificateError) and error.reason == REVOKED
        return False

    def forget_all_but(self, names: set[NodeName]) -> None:
        """Keep `ignored` for these names only: the others are no peers any more."""
        self.ignored = {name: why for name, why in self.ignored.items() if name in names}


def _cut(candidates: tuple[Candidate, ...]) -> tuple[Candidate, ...]:
    """Return the first MAX_CANDIDATES_OF_INTERFACE candidates of each interface."""
    counts: Counter[InterfaceId] = Counter()
    used = []
    for candidate in candidates:
        counts[candidate.interface_id] += 1
        if counts[candidate.interface_id] <= MAX_CANDIDATES_OF_INTERFACE:
            used.append(candidate)
    return tuple(used)
