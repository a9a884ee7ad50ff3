"""Judges peers' credentials outside the engine's lock, follows changes of trust, and logs which peers are not used."""

from __future__ import annotations

import contextlib
import logging
from itertools import islice
from typing import TYPE_CHECKING

from plr.protos.base.errors import DecodeError

if TYPE_CHECKING:
    import threading
    from collections.abc import Callable, Iterable, Mapping

    from plr.protos.model.ids import NodeName, ServiceName
    from plr.protos.model.members import Peer
    from plr.sidecar.core.crypto.session import OwnSession
    from plr.sidecar.core.engine.engine import Engine
    from plr.sidecar.net.engine_turn import EngineTurn

log = logging.getLogger(__name__)


class PeerTrust:
    """The data plane's trust in its peers; every method may be called from any thread."""

    def __init__(
        self,
        own: OwnSession,
        engine: Engine,
        lock: threading.RLock,
        turn: EngineTurn,
        reach_changed: Callable[[], None],
    ) -> None:
        """Read `engine` under `lock`, change it in `turn`; call `reach_changed` when peers may have come."""
        self._own = own
        self._engine = engine
        self._lock = lock
        self._turn = turn
        self._reach_changed = reach_changed
        self._logged_refusals: dict[NodeName, str] = {}
        """Peer -> the cause logged last."""
        self._logged_candidates: dict[NodeName, str] = {}
        self._logged_conflicts: frozenset[tuple[ServiceName, NodeName, str]] = frozenset()

    def judge(self, peers: Iterable[Peer]) -> list[Peer]:
        """Do the public-key work for these peers before the engine, under its lock, asks for the result.

        Return the good ones.
        """
        good = []
        for peer in peers:
            with contextlib.suppress(DecodeError):
                self._own.admit(peer)
                good.append(peer)
                self._own.check_candidates(peer)
        return good

    def trust_changed(self) -> None:
        """Follow a change of CAs or revocations: peers that are no longer trusted lose their sessions at once.

        Refused peers may be good now.
        """
        self._own.forget_admitted()
        with self._lock:
            known, refused = self._engine.peers.all_held(), self._engine.peers.all_refused()
        self.judge(known)
        self._recheck(self.judge(refused))

    def end_expired(self, now_wall: float) -> None:
        """Drop peers whose certificates have ended by now (seconds since 1970); nearly free if there are none.

        Log which other peers are refused from now on.
        """
        if self._own.forget_ended(now_wall):
            with self._lock:
                known = self._engine.peers.all_held()
            self.judge(known)
            self._recheck([])
        self.log_news()

    def judge_again(self) -> None:
        """Judge refused peers again: time has passed, or our clock was set, and they may be good now."""
        with self._lock:
            refused = self._engine.peers.all_refused()
        good = self.judge(refused)
        if good:
            self._recheck(good)

    def _recheck(self, judged: list[Peer]) -> None:
        with self._turn as (engine, now):
            taken = engine.recheck_peers(judged, now)
        for name in taken:
            log.info("%s is accepted now: its credential has become valid", name)
        self.log_news()
        self._reach_changed()

    def set_revocations(self, numbers: Mapping[int, int], pem: bytes) -> None:
        """Tell peers about these lists, and send them when asked; see `RevocationExchange.set_own`."""
        with self._turn as (engine, now):
            engine.revocations.set_own(numbers, pem, now)

    def judged_revocations(self, peer: NodeName, *, good: bool) -> None:
        """Note that a peer's lists were accepted, or are no lists of our CAs."""
        with self._turn as (engine, now):
            engine.revocations.on_judged(peer, now, good=good)

    def refused(self, at_most: int) -> list[tuple[NodeName, str]]:
        """Return the peers that are refused, and why."""
        with self._lock:
            refused = list(islice(self._engine.peers.refused.values(), at_most))
        return [(refusal.peer.name, refusal.why) for refusal in refused]

    def log_news(self) -> None:
        """Log news about peers that are refused, or get no requests."""
        with self._lock:
            conflicts = self._engine.offer_conflicts
            refused = list(self._engine.peers.refused.values())
            ignored = dict(self._engine.peers.ignored_candidates)
            used_again = [name for name in self._logged_candidates.keys() - ignored if name in self._engine.peers]
        for refusal in refused:
            if self._logged_refusals.get(refusal.peer.name) != refusal.cause:
                name, why = refusal.peer.name, refusal.why
                log.warning("%s is refused, although the control plane names it as a peer: %s", name, why)
        self._logged_refusals = {refusal.peer.name: refusal.cause for refusal in refused}
        for name, why in ignored.items():
            if self._logged_candidates.get(name) != why:
                log.warning("%s: the addresses that the control plane sent for it are not used: %s", name, why)
        for name in used_again:
            log.info("%s: the addresses that the control plane sent for it are used again", name)
        self._logged_candidates = ignored
        for service, server, kind in sorted(conflicts - self._logged_conflicts):
            log.warning(
                "%s at %s has type %s, unlike the configuration or the other servers: it gets no requests",
                service,
                server,
                kind,
            )
        self._logged_conflicts = conflicts
