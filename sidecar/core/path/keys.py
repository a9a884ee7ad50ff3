"""Seals and opens the datagrams of one path, and changes its keys from phase to phase.

Bit 1 of the flags is the phase's parity. The receiver holds the current keys, the previous ones for late datagrams, and
the next ones as soon as they are agreed on (key_exchange.py). It switches with the first datagram that opens with the
next ones, so that nothing pauses.

The nonce is the last 12 of the 20 clear bytes: half of the sender's session, and the packet number, which never repeats
within a session. A path's keys belong to one session, path and direction (`key_schedule.py`), so no nonce repeats under
a key. The packet numbers that a path used and opened outlive it (`memory.py`).
"""

from __future__ import annotations

import math
from copy import copy, deepcopy
from typing import TYPE_CHECKING

from cryptography.exceptions import InvalidTag

from plr.sidecar.core.crypto import aead as ciphers
from plr.sidecar.core.path.key_exchange import KeyExchange
from plr.sidecar.core.path.received import ReceivedPackets
from plr.sidecar.core.wire.frame import PHASE_FLAG, clear_head

if TYPE_CHECKING:
    import random

    from cryptography.utils import Buffer

    from plr.protos.base.token_bucket import TokenBucket
    from plr.protos.model.ids import InterfaceId
    from plr.protos.trust.credential import Aead
    from plr.sidecar.core.crypto.aead import Cipher
    from plr.sidecar.core.crypto.key_schedule import PairKeys
    from plr.sidecar.core.path.key_exchange import KeyLimits
    from plr.sidecar.core.wire.frame import KeyAnswer, KeyOffer

_PHASE = PHASE_FLAG << 16
"""The phase bit in the first four clear bytes as one number."""
LATE_S = 10.0
"""The previous keys are dropped this long after something opened with the next ones: whatever else they sealed has
arrived by then, or never will."""
MAX_FAILED = 1 << 36
"""Datagrams that fail one phase's keys before these stop opening anything (RFC 9001 section 6.6, the lower limit)."""


class SealingKeys:
    """The sender's end of one direction of a path."""

    __slots__ = ("_aead", "encrypt_into", "head", "phase", "sealed")

    def __init__(self, aead: Aead, key: bytes, head: int) -> None:
        self._aead = aead
        self.phase = 0
        """Counts the changes of keys."""
        self.head = head
        """The first four clear bytes of the datagrams sealed now, as one number."""
        self.sealed = 0
        """Datagrams sealed in this phase."""
        self.encrypt_into = ciphers.make_cipher(aead, key).encrypt_into

    def advance(self, key: bytes) -> None:
        """Switch to the next phase's key."""
        self.phase += 1
        self.head ^= _PHASE
        self.sealed = 0
        self.encrypt_into = ciphers.make_cipher(self._aead, key).encrypt_into


class OpeningKeys:
    """The receiver's end of one direction of a path."""

    __slots__ = ("_aead", "_current", "_next", "_previous", "decrypt_into", "failed", "first", "head", "phase")

    def __init__(self, aead: Aead, key: bytes, head: int) -> None:
        self._aead = aead
        self.phase = 0
        self.head = head
        """The first four clear bytes of the current phase's datagrams, as one number: `decrypt_into` opens these."""
        self._current = ciphers.make_cipher(aead, key)
        self.decrypt_into = self._current.decrypt_into
        self.first = 0
        """The packet number that began the current phase."""
        self._previous: Cipher | None = None
        self._next: Cipher | None = None
        self.failed = 0
        """Datagrams of this phase that did not open."""

    def expect(self, key: bytes) -> None:
        """Prepare the next phase's key, which has been agreed on."""
        self._next = ciphers.make_cipher(self._aead, key)

    def open_other(self, nonce: Buffer, sealed: Buffer, associated_data: Buffer, out: Buffer, /) -> int:
        """Do as `decrypt_into` for a datagram of the other parity than `head`: of the previous or the next phase."""
        # The packet number.
        number = int.from_bytes(nonce[-8:], "big")
        if number < self.first and self._previous is not None:
            return self._previous.decrypt_into(nonce, sealed, associated_data, out)
        if self._next is None:
            raise InvalidTag
        size = self._next.decrypt_into(nonce, sealed, associated_data, out)
        self.advance(number)
        return size

    def advance(self, number: int) -> None:
        """Switch to the expected key, from this packet number on."""
        assert self._next is not None
        # Phase 0 sealed only probes, and anybody with one of the sessions' keys could have sealed them.
        self._previous = self._current if self.phase else None
        self.phase += 1
        self.head ^= _PHASE
        self.first = number
        self._current, self._next = self._next, None
        self.decrypt_into = self._current.decrypt_into
        self.failed = 0

    def forget_previous(self) -> None:
        """Stop opening what the previous keys sealed."""
        self._previous = None


class PathKeys:
    """The keys and numbers of one path. They last as long as the peer's session, whatever becomes of the path."""

    __slots__ = (
        "_exchange",
        "_forget_at",
        "_most",
        "_opened_phase",
        "_pair",
        "incarnation",
        "introduced",
        "offered",
        "opening",
        "received",
        "sealing",
    )

    def __init__(
        self,
        pair: PairKeys,
        exchange: KeyExchange,
        sealing: SealingKeys,
        opening: OpeningKeys,
        most: int,
        incarnation: int,
    ) -> None:
        """Create the keys; `most`: datagrams that one phase seals."""
        self._pair = pair
        self._exchange = exchange
        self._most = most
        self._opened_phase = 0
        """The last phase that is known to have opened something."""
        self._forget_at = math.inf
        """When the previous keys are dropped (s)."""
        self.sealing = sealing
        self.opening = opening
        self.received = ReceivedPackets()
        """The packet numbers that came; none is accepted twice."""
        self.incarnation = incarnation
        """Incarnation of the peer's session; a later session has a larger one."""
        self.introduced = -1
        """The largest packet number of the peer's introductions. A smaller one is a replay, was overtaken, ..."""
        self.offered = -1
        """... or is the peer's own, sent after one forged by somebody who knows the token alone. The peer's own is then
        larger than this, the largest one whose offer had a true proof."""

    def copy(self) -> PathKeys:
        """Return an independent copy."""
        sealing, opening = copy(self.sealing), copy(self.opening)
        other = PathKeys(self._pair, copy(self._exchange), sealing, opening, self._most, self.incarnation)
        other.received = deepcopy(self.received)
        other.introduced, other.offered = self.introduced, self.offered
        other._opened_phase, other._forget_at = self._opened_phase, self._forget_at
        return other

    @property
    def are_fresh(self) -> bool:
        """Whether the sealing keys come from an exchange and are not worn out, so that requests may go."""
        return self.sealing.phase > 0 and self.sealing.sealed < self._most

    @property
    def offers_at(self) -> float:
        """When a probe leaves just to carry an offer, if none does before (s)."""
        if self.opening.phase < self.sealing.phase:
            return math.inf
        return self._exchange.offers_at(self._datagrams())

    def offer(self, now: float, rng: random.Random) -> KeyOffer | None:
        """Return the offer for the next probe, if new keys are due."""
        self._forget_previous(now)
        if self.opening.phase < self.sealing.phase:
            return None  # the peer has not followed yet
        return self._exchange.offer(self._datagrams(), now, rng)

    def _datagrams(self) -> int:
        """Return the datagrams of this phase, either way: the peer sealed about as many as came."""
        return max(self.sealing.sealed, self.received.largest - self.opening.first)

    @property
    def has_answered(self) -> bool:
        """Whether the peer may have switched to keys that have opened nothing yet."""
        return self._exchange.has_answered

    def answer(
        self, offer: KeyOffer, now: float, rng: random.Random, budget: TokenBucket | None = None
    ) -> KeyAnswer | None:
        """Return the answer to an offer, if there is one; raises DecodeError. `budget`: see `KeyExchange.take`."""
        if self.opening.phase > self.sealing.phase:
            # The peer switched to the keys it offered, in a datagram that nobody has read (yet). Expected once more,
            # the same key would open a phase that no exchange agreed on.
            return None
        answered = self._exchange.answer(offer, now, rng, budget)
        if answered is None:
            return None
        answer, root = answered
        self.opening.expect(self._pair.opening_key(root))
        return answer

    def take(self, answer: KeyAnswer, now: float, budget: TokenBucket | None = None) -> bool:
        """Switch to the keys that an answer completes; False if it answers no pending offer. Raises DecodeError."""
        root = self._exchange.take(answer, now, budget)
        if root is None:
            return False
        self.opening.expect(self._pair.opening_key(root))
        self.sealing.advance(self._pair.sealing_key(root))
        return True

    def follow(self, now: float) -> bool:
        """Seal with the keys that our answer agreed on once something opened with them; True if that is new."""
        if self.opening.phase != self._opened_phase:
            self._opened_phase = self.opening.phase
            self._forget_at = now + LATE_S
        elif now >= self._forget_at:
            self._forget_previous(now)
        if self.opening.phase <= self.sealing.phase:
            return False
        self.sealing.advance(self._pair.sealing_key(self._exchange.confirmed(now)))
        return True

    def _forget_previous(self, now: float) -> None:
        if now >= self._forget_at:
            self.opening.forget_previous()
            self._forget_at = math.inf


def make_path_keys(
    pair: PairKeys,
    ours: InterfaceId,
    theirs: InterfaceId,
    limits: KeyLimits,
    now: float,
    incarnation: int = 0,
    *,
    leads: bool,
) -> PathKeys:
    """Return the keys of a path that neither end has used; `incarnation` is that of the peer's session."""
    root = pair.root(ours, theirs)
    return PathKeys(
        pair,
        KeyExchange(pair, root, limits, now, leads=leads),
        SealingKeys(pair.aead, pair.sealing_key(root), clear_head(ours, theirs)),
        OpeningKeys(pair.aead, pair.opening_key(root), clear_head(theirs, ours)),
        limits.sealed,
        incarnation,
    )
