"""Agrees on fresh keys for each phase of one path (in the spirit of Noise IK and WireGuard).

The leading end offers a new public key, with a proof that it knows the keys in use. The other end answers with a public
key of its own, and with a proof that it could compute the result of both keys and of the two sessions' keys
(key_schedule.py). The new private keys are forgotten with the exchange. So memory read one day opens nothing that was
sealed a phase earlier, and a thief of one end's session key cannot impersonate the other end to it.

The offer travels with the probes and introductions until it is answered, and stays the same; the same offer gets the
same answer. The leader switches to the new keys when it has the answer, the other end when something opens with them.
Before its first exchange a path is in phase 0, whose keys follow from the sessions' keys alone: it carries nothing but
probes and this exchange.
"""

from __future__ import annotations

import hmac
import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from cryptography.hazmat.primitives.asymmetric.x25519 import X25519PrivateKey, X25519PublicKey

from plr.protos.base.errors import DecodeError
from plr.sidecar.core.crypto.key_schedule import next_root, proof, proof_of_offer
from plr.sidecar.core.wire.frame import KeyAnswer, KeyOffer

if TYPE_CHECKING:
    import random

    from plr.protos.base.token_bucket import TokenBucket
    from plr.sidecar.core.crypto.key_schedule import PairKeys

RENEW_AFTER_S = 120.0
"""Age of a phase at which the next one is offered, as in WireGuard."""
RENEW_AFTER_DATAGRAMS = 1 << 21
"""Datagrams of one phase, either way, after which the next one is offered, with the next probe, half a second later."""
MAX_PHASE = 0xFFFFFFFF
"""The last phase that an offer can name: at two minutes each, some 16,000 years."""
MAX_SEALED = 1 << 23
"""Datagrams that one phase seals (RFC 9001 section 6.6, for AES-GCM and the longest). A peer that agrees on no new keys
by then gets nothing but probes."""
WAITS_SHARE, WAITS_S = 8.0, 15.0
"""Where requests prove that a path lives, no probe leaves. A due offer then waits this share of a phase's age, at most
this long, for a probe to ride on, and after that gets its own."""
AGAIN_S = 1.0
"""The same wait for an offer that was sent and not answered."""
OTHER_OFFER_AFTER_S = 1.0
"""Least time between two different offers that are answered. An honest leader repeats its offer: ignoring another one
costs us nothing, and the leader only time."""


EXCHANGES_PER_S = 10.0
"""Rate of exchanges processed for all paths to one peer: each costs 0.3 ms of public-key work per datagram of some
hundred bytes. An honest peer needs one for each path every two minutes, ..."""
EXCHANGES_AT_ONCE = 64.0
"""... or for all its paths at once, after a restart."""


class TooManyExchangesError(DecodeError):
    """The peer asks for more exchanges than are processed."""


@dataclass(frozen=True, slots=True)
class KeyLimits:
    """When a path's keys are changed."""

    datagrams: int = RENEW_AFTER_DATAGRAMS
    seconds: float = RENEW_AFTER_S
    sealed: int = MAX_SEALED


DEFAULT_LIMITS = KeyLimits()


@dataclass(slots=True)
class _Exchange:
    """A pending exchange: the leader's offer, or the other end's answer to it."""

    offer: KeyOffer
    began_at: float
    offered_at: float
    private: X25519PrivateKey | None = field(default=None, repr=False)
    """The leader's."""
    answer: KeyAnswer | None = None
    root: bytes = field(default=b"", repr=False)
    """The root that the answer agrees on."""


class KeyExchange:
    """The phases of one path, at one of its ends."""

    __slots__ = ("_changed_at", "_exchange", "_leads", "_limits", "_pair", "_root", "phase")

    def __init__(self, pair: PairKeys, root: bytes, limits: KeyLimits, now: float, *, leads: bool) -> None:
        self._pair = pair
        self._limits = limits
        self._root = root
        self._leads = leads
        self._changed_at = now
        self._exchange: _Exchange | None = None
        self.phase = 0
        """The phase that we seal with."""

    @property
    def changed_at(self) -> float:
        """When the phase began (s)."""
        return self._changed_at

    # -- the end that leads ---------------------------------------------------------------------------------------

    def offers_at(self, datagrams: int) -> float:
        """Return when a probe leaves just to carry an offer (s); `datagrams`: of this phase, either way."""
        if not self._leads:
            return math.inf
        if self._exchange is not None:
            return self._exchange.offered_at + AGAIN_S
        if datagrams >= self._limits.datagrams:
            return self._changed_at
        return self._changed_at + self._limits.seconds + min(self._limits.seconds / WAITS_SHARE, WAITS_S)

    def offer(self, datagrams: int, now: float, rng: random.Random) -> KeyOffer | None:
        """Return the offer for the next probe, if new keys are due; `datagrams`: of this phase, either way."""
        if not self._leads:
            return None
        if self._exchange is None:
            due = now >= self._changed_at + self._limits.seconds or datagrams >= self._limits.datagrams
            if (self.phase and not due) or self.phase == MAX_PHASE:
                return None
            private = X25519PrivateKey.from_private_bytes(rng.randbytes(32))
            phase, key = self.phase + 1, private.public_key().public_bytes_raw()
            offer = KeyOffer(phase, key, proof_of_offer(self._root, phase, key))
            self._exchange = _Exchange(offer, now, now, private)
        self._exchange.offered_at = now
        return self._exchange.offer

    def take(self, answer: KeyAnswer, now: float, budget: TokenBucket | None = None) -> bytes | None:
        """Return the new root that an answer completes; None if it answers no pending offer.

        `budget` limits how many exchanges are processed; None: no limit.

        Raises:
            DecodeError: the sender does not have the peer's session key.
            TooManyExchangesError: the budget is spent.
        """
        exchange = self._exchange
        if not self._leads or exchange is None or exchange.private is None or answer.phase != exchange.offer.phase:
            return None
        _pay(budget, now)
        theirs = _public(answer.key)
        shared = (
            _shared(exchange.private, theirs)
            + _shared(exchange.private, self._pair.theirs)
            + _shared(self._pair.own, theirs)
        )
        root = next_root(self._root, shared, answer.phase, exchange.offer.key, answer.key)
        if not hmac.compare_digest(proof(root), answer.proof):
            raise DecodeError("the proof of new keys is wrong")
        self._begin(root, now)
        return root

    # -- the other end --------------------------------------------------------------------------------------------

    def answer(
        self, offer: KeyOffer, now: float, rng: random.Random, budget: TokenBucket | None = None
    ) -> tuple[KeyAnswer, bytes] | None:
        """Return the answer to an offer, and the root to expect from now on; None if it is not answered.

        `budget`: see `take`.

        Raises:
            DecodeError: the sender does not know the keys in use, or its key is of small order.
            TooManyExchangesError: the budget is spent.
        """
        if self._leads or offer.phase != self.phase + 1:
            return None
        if not hmac.compare_digest(proof_of_offer(self._root, offer.phase, offer.key), offer.proof):
            raise DecodeError("the proof of an offer of new keys is wrong")
        before = self._exchange
        if before is not None and before.answer is not None:
            if before.offer == offer:
                return before.answer, before.root
            if now < before.began_at + OTHER_OFFER_AFTER_S:
                return None
        _pay(budget, now)
        private, theirs = X25519PrivateKey.from_private_bytes(rng.randbytes(32)), _public(offer.key)
        shared = _shared(private, theirs) + _shared(self._pair.own, theirs) + _shared(private, self._pair.theirs)
        key = private.public_key().public_bytes_raw()
        root = next_root(self._root, shared, offer.phase, offer.key, key)
        answer = KeyAnswer(offer.phase, key, proof(root))
        self._exchange = _Exchange(offer, now, now, answer=answer, root=root)
        return answer, root

    @property
    def has_answered(self) -> bool:
        """Whether the leader may have switched to the keys that our answer agreed on."""
        return self._exchange is not None and self._exchange.answer is not None

    def confirmed(self, now: float) -> bytes:
        """Switch to the root that our answer agreed on, since the leader seals with it, and return it."""
        assert self._exchange is not None
        root = self._exchange.root
        self._begin(root, now)
        return root

    def _begin(self, root: bytes, now: float) -> None:
        self._root = root
        self._exchange = None
        self._changed_at = now
        self.phase += 1


def _pay(budget: TokenBucket | None, now: float) -> None:
    if budget is not None and not budget.take(now):
        raise TooManyExchangesError("too many key exchanges")


def _public(key: bytes) -> X25519PublicKey:
    return X25519PublicKey.from_public_bytes(key)


def _shared(private: X25519PrivateKey, public: X25519PublicKey) -> bytes:
    try:
        return private.exchange(public)
    except ValueError:  # RFC 7748 section 6.1
        raise DecodeError("the public key has small order") from None
