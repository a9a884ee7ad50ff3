"""Provides the ciphers that seal datagrams: AEAD (RFC 5116), from buffer to buffer."""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

from cryptography.hazmat.primitives.ciphers.aead import AESGCM, ChaCha20Poly1305

from plr.protos.trust.credential import Aead

if TYPE_CHECKING:
    from cryptography.utils import Buffer

KEY_BYTES = 32
NONCE_BYTES = 12
TAG_BYTES = 16
"""The tag follows the ciphertext, which is as long as the plaintext."""


class Cipher(Protocol):
    """One key of an AEAD."""

    def encrypt_into(self, nonce: Buffer, data: Buffer, associated_data: Buffer, buf: Buffer, /) -> int:
        """Write ciphertext and tag of `data` to `buf`, which may begin where `data` does."""

    def decrypt_into(self, nonce: Buffer, data: Buffer, associated_data: Buffer, buf: Buffer, /) -> int:
        """Write the plaintext to `buf`; if `data` is not authentic, raise InvalidTag and leave garbage there."""


def make_cipher(aead: Aead, key: bytes) -> Cipher:
    """Return the cipher with a key of KEY_BYTES."""
    return AESGCM(key) if aead is Aead.AES_256_GCM else ChaCha20Poly1305(key)


def choose(one: Aead, other: Aead) -> Aead:
    """Return the AEAD of two sidecars that prefer these: AES only if both are fast at it."""
    return Aead.AES_256_GCM if one is other is Aead.AES_256_GCM else Aead.CHACHA20_POLY1305
