"""Keys of one path: sealing what leaves, opening what comes, and their phases (in the spirit of RFC 9001 section 6).

The sender goes to the next phase by age and by volume, once an answer showed that the peer has the present one; bit 1
of the flags is the phase's parity. The receiver holds the keys before, in use and next, and follows with the first
datagram that opens with the next: nothing pauses, nothing is negotiated.

The nonce is the last 12 of the 20 clear bytes: half of the sender's session, and the packet number, which never
repeats within a session. A path's keys belong to one session, path and direction (`key_schedule.py`), so no nonce
repeats under a key. What a path numbered and opened outlives it (`link_memory.py`).
"""

from __future__ import annotations

from copy import copy, deepcopy
from dataclasses import dataclass
from typing import TYPE_CHECKING

from sidecar.core import aead as ciphers
from sidecar.core.frame import PHASE_FLAG, clear_head
from sidecar.core.key_schedule import next_phase, phase_key
from sidecar.core.received import ReceivedPackets

if TYPE_CHECKING:
    from cryptography.utils import Buffer

    from protos.credential import Aead
    from protos.model import InterfaceId
    from sidecar.core.aead import Cipher
    from sidecar.core.key_schedule import PairKeys

_PHASE = PHASE_FLAG << 16
"""The phase bit in the first four clear bytes as one number."""
MAX_SEALED_DATAGRAMS = 1 << 22
"""Datagrams sealed with one key, unless the peer confirms none of them; AES-GCM bears 2^23 of the longest by RFC 9001
section 6.6, and a path over which nothing is confirmed is down long before."""
REKEY_AFTER_S = 3600.0
"""Age of a key at which it is changed."""


@dataclass(frozen=True, slots=True)
class KeyLimits:
    """When a sender changes a path's keys."""

    datagrams: int = MAX_SEALED_DATAGRAMS
    seconds: float = REKEY_AFTER_S


DEFAULT_LIMITS = KeyLimits()


class SealingKeys:
    """The sender's end of one direction of a path."""

    __slots__ = ("_aead", "_began_at", "_confirmed", "_limits", "_sealed", "_secret", "encrypt_into", "head", "phase")

    def __init__(self, aead: Aead, secret: bytes, head: int, limits: KeyLimits, now: float) -> None:
        self._aead = aead
        self._limits = limits
        self.phase = 0
        """Counts the changes of keys."""
        self.head = head
        """The first four clear bytes of what is sealed now, as one number."""
        self._begin(secret, now)

    def _begin(self, secret: bytes, now: float) -> None:
        self._secret = secret
        self.encrypt_into = ciphers.make_cipher(self._aead, phase_key(secret)).encrypt_into
        self._began_at = now
        self._sealed = 0
        self._confirmed = False

    def use(self, datagrams: int, now: float) -> None:
        """So many datagrams are sealed next, with `head` and `encrypt_into` as they are after this call."""
        if self._confirmed and (self._sealed >= self._limits.datagrams or now >= self._began_at + self._limits.seconds):
            self.phase += 1
            self.head ^= _PHASE
            self._begin(next_phase(self._secret), now)
        self._sealed += datagrams

    def delivered(self, sent_at: float) -> None:
        """The peer opened a datagram that left at this time (s)."""
        # Not those of the very moment of the change: they may have left before it.
        if sent_at > self._began_at:
            self._confirmed = True


class OpeningKeys:
    """The receiver's end of one direction of a path."""

    __slots__ = ("_aead", "_current", "_first", "_next", "_next_secret", "_previous", "decrypt_into", "head", "phase")

    def __init__(self, aead: Aead, secret: bytes, head: int) -> None:
        self._aead = aead
        self.phase = 0
        self.head = head
        """The first four clear bytes of datagrams of the phase in use, as one number: `decrypt_into` opens these."""
        self._current = self._cipher(secret)
        self.decrypt_into = self._current.decrypt_into
        self._first = 0
        """The packet number that began the phase in use."""
        self._previous: Cipher | None = None
        self._prepare(secret)

    def _cipher(self, secret: bytes) -> Cipher:
        return ciphers.make_cipher(self._aead, phase_key(secret))

    def _prepare(self, secret: bytes) -> None:
        # Beforehand, so that the time it takes tells nobody that a datagram was of the next phase (RFC 9001, 6.3).
        self._next_secret = next_phase(secret)
        self._next = self._cipher(self._next_secret)

    def open_other(self, nonce: Buffer, sealed: Buffer, associated_data: Buffer, out: Buffer, /) -> int:
        """As `decrypt_into`, for a datagram of the other parity than `head`: of the phase before, or of the next."""
        # The packet number.
        number = int.from_bytes(nonce[-8:], "big")
        if self._previous is not None and number < self._first:
            return self._previous.decrypt_into(nonce, sealed, associated_data, out)
        size = self._next.decrypt_into(nonce, sealed, associated_data, out)
        self.phase += 1
        self.head ^= _PHASE
        self._first = number
        self._previous, self._current = self._current, self._next
        self.decrypt_into = self._current.decrypt_into
        self._prepare(self._next_secret)
        return size


class PathKeys:
    """What is known of one path for as long as its peer's session, whatever becomes of the path."""

    __slots__ = ("incarnation", "introduced", "opening", "received", "sealing")

    def __init__(
        self,
        sealing: SealingKeys,
        opening: OpeningKeys,
        received: ReceivedPackets,
        incarnation: int,
        introduced: int = -1,
    ) -> None:
        self.sealing = sealing
        self.opening = opening
        self.received = received
        """The packet numbers that came: none is accepted twice."""
        self.incarnation = incarnation
        """Of the peer's session: a later session's is larger."""
        self.introduced = introduced
        """The largest packet number of the peer's introductions: a smaller one is a replay, or overtaken."""

    def copy(self) -> PathKeys:
        """Return the same, apart from these from now on."""
        return PathKeys(
            copy(self.sealing), copy(self.opening), deepcopy(self.received), self.incarnation, self.introduced
        )


def make_path_keys(
    pair: PairKeys, ours: InterfaceId, theirs: InterfaceId, limits: KeyLimits, now: float, incarnation: int = 0
) -> PathKeys:
    """Return the keys of a path that neither end has used; `incarnation` is that of the peer's session."""
    return PathKeys(
        SealingKeys(pair.aead, pair.sending(ours, theirs), clear_head(ours, theirs), limits, now),
        OpeningKeys(pair.aead, pair.receiving(ours, theirs), clear_head(theirs, ours)),
        ReceivedPackets(),
        incarnation,
    )
