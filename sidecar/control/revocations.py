"""Keeps this sidecar's revocation lists, whatever their source, and tells the data plane what they say.

A list comes from the node's folder, the control plane, a peer, or the disk. `TlsWatch` judges each on the control
client's thread, and all have the same effect.
"""

from __future__ import annotations

import logging
import math
from collections import deque
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

from plr.protos.convert.fields import MAX_CRL_BYTES
from plr.protos.trust.identity import CertificateError
from plr.protos.trust.revocation_views import revocation_set

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from plr.protos.model.ids import NodeName
    from plr.protos.model.members import RevocationSet
    from plr.protos.program.tls_files import TlsWatch
    from plr.protos.trust.identity import RevocationList

log = logging.getLogger(__name__)

MAX_UNJUDGED_LISTS = 16
"""Peers' lists that may wait to be judged, which happens every second; the exchange asks for one every 5 s."""
CLOCK_SLACK_S = 300.0
"""A list signed this much later than now shows that this clock is behind; certificates are backdated by as much."""


class RevocationUser(Protocol):
    """The calls that `Revocations` makes to the data plane (`PeerTrust`)."""

    def trust_changed(self) -> None:
        """Judge all peers again."""

    def set_revocations(self, numbers: Mapping[int, int], pem: bytes) -> None:
        """Announce these lists to peers, and hold them ready for requests."""

    def judged_revocations(self, peer: NodeName, *, good: bool) -> None:
        """Report whether a peer's lists were taken, or are none of our CAs."""


@dataclass(frozen=True, slots=True)
class RevocationState:
    """State of the revocation lists for the metrics."""

    lists: Mapping[int, RevocationList | None]
    """As `Trust.lists`."""
    too_old: frozenset[int]
    """CAs whose lists are too old; nodes that they certified are refused."""
    max_age_s: float


class Revocations:
    """The lists in use. Any thread may call `heard` and `state`, only the control client's may call the rest."""

    def __init__(
        self,
        tls: TlsWatch,
        user: RevocationUser,
        remember: Callable[[bytes], None],
        show: Callable[[RevocationSet], None],
        max_age_s: float = math.inf,
    ) -> None:
        """Use `remember` to keep lists across a restart, and `show` to tell the operator which they are.

        Peers of a CA whose list is older than `max_age_s` are not believed (`Trust.check`).
        """
        self._tls = tls
        self._user = user
        self._remember = remember
        self._show = show
        self._max_age_s = max_age_s
        self._heard: deque[tuple[NodeName, bytes]] = deque()
        self._complained: set[NodeName] = set()
        """Peers whose bad lists were logged; at most as many as there are peers."""
        self._too_long = False
        self._clock_behind = False
        self._too_old: frozenset[int] = frozenset()

    @property
    def state(self) -> RevocationState:
        """The lists in use."""
        return RevocationState(self._tls.current.trust.lists(), self._too_old, self._max_age_s)

    def heard(self, peer: NodeName, pem: bytes) -> None:
        """Queue lists that a peer sent; `look` judges them."""
        if len(self._heard) == MAX_UNJUDGED_LISTS:
            log.warning("a revocation list is dropped unread: %d others already wait to be checked", MAX_UNJUDGED_LISTS)
            return
        self._heard.append((peer, pem))

    def take(self, pem: bytes, source: str) -> bool:
        """Add these lists to those in use; return whether they say anything new. Raises CertificateError."""
        if not self._tls.take_revocations(pem):
            return False
        trust = self._tls.current.trust
        shown = ", ".join(f"number {one.number}" for one in trust.lists().values() if one is not None)
        log.info("took a new revocation list from %s: %s", source, shown)
        self._remember(trust.crl_pem())
        self._user.trust_changed()
        self.tell()
        return True

    def take_or_log(self, pem: bytes, source: str) -> None:
        """Do the same, but log bad lists instead of raising."""
        try:
            self.take(pem, source)
        except CertificateError as error:
            log.warning("a revocation list from %s is ignored: %s", source, error)

    def tell(self) -> None:
        """Tell the data plane and the operator which lists are in use; they may have changed."""
        trust = self._tls.current.trust
        pem = trust.crl_pem()
        too_long = len(pem) > MAX_CRL_BYTES
        if too_long and not self._too_long:
            log.error("the revocation lists have more than %d bytes: they are not sent to peers", MAX_CRL_BYTES)
        self._too_long = too_long
        self._say()
        numbers = {ca: -1 if one is None else one.number for ca, one in trust.lists().items()}
        self._user.set_revocations(numbers, b"" if too_long else pem)

    def _say(self) -> None:
        self._show(revocation_set(self._tls.current.trust.lists(), len(self._too_old)))

    def look(self, now_wall: float) -> None:
        """Judge what peers sent, and how old the lists are at `now_wall` (seconds since 1970). Call it every second."""
        while self._heard:
            self._judge(*self._heard.popleft())
        self._look_at_ages(now_wall)

    def _judge(self, peer: NodeName, pem: bytes) -> None:
        try:
            taken = self.take(pem, peer)
        except CertificateError as error:
            self._user.judged_revocations(peer, good=False)
            if peer not in self._complained:
                log.warning(
                    "a revocation list from %s is ignored, and this peer is not asked again for an hour: %s",
                    peer,
                    error,
                )
                self._complained.add(peer)
            return
        if taken:
            self._user.judged_revocations(peer, good=True)

    def _look_at_ages(self, now_wall: float) -> None:
        trust = self._tls.current.trust
        ahead_s = max((one.signed_at - now_wall for one in trust.lists().values() if one is not None), default=0.0)
        behind = ahead_s > CLOCK_SLACK_S
        if behind and not self._clock_behind:
            log.error(
                "a revocation list was signed %.0f s in the future: this clock is behind, or the CA's clock is ahead",
                ahead_s,
            )
        self._clock_behind = behind
        too_old = trust.too_old(now_wall, self._max_age_s)
        if too_old == self._too_old:
            return
        if too_old:
            log.error(
                "the revocation lists of %d of %d CAs are older than max_revocation_age_s (%.0f s) by this clock, or "
                "missing: nodes of these CAs are refused until newer lists arrive (plr ca publish); if the lists are "
                "newer than that, this clock is wrong",
                len(too_old),
                len(trust.lists()),
                self._max_age_s,
            )
        else:
            log.warning("the revocation lists are recent enough again: their nodes are accepted")
        self._too_old = too_old
        self._say()
        self._user.trust_changed()
