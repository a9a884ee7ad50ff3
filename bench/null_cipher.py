"""A cipher that only copies, for measuring what sealing costs. No program of ours imports it but benchmarks.

It takes the place of the AEAD where that is made, in this process; no configuration leads here. It is itself a call
into Python for each datagram at either end, 0.2 us each: by so much sealing looks cheaper than it is.
"""

from __future__ import annotations

import contextlib
from typing import TYPE_CHECKING

from sidecar.core.crypto import aead

if TYPE_CHECKING:
    from collections.abc import Iterator

    from cryptography.utils import Buffer

    from protos.trust.credential import Aead
    from sidecar.core.crypto.aead import Cipher


class NullCipher:
    """Copies, in place of encrypting and authenticating; the tag is whatever the buffer held."""

    @staticmethod
    def encrypt_into(nonce: Buffer, data: Buffer, associated_data: Buffer, buf: Buffer, /) -> int:
        """As a Cipher's."""
        buf[: -aead.TAG_BYTES] = data  # type: ignore[index]  # a bytearray or memoryview
        return 0

    @staticmethod
    def decrypt_into(nonce: Buffer, data: Buffer, associated_data: Buffer, buf: Buffer, /) -> int:
        """As a Cipher's, but of whatever comes."""
        buf[:] = data[: -aead.TAG_BYTES]  # type: ignore[index]  # a bytearray or memoryview
        return 0


def install() -> None:
    """Seal nothing from now on, in this process."""
    aead.make_cipher = _make_null


@contextlib.contextmanager
def null_cipher() -> Iterator[None]:
    """Seal nothing within the block, with keys that are made there."""
    real = aead.make_cipher
    install()
    try:
        yield
    finally:
        aead.make_cipher = real


def _make_null(aead: Aead, key: bytes) -> Cipher:
    return NullCipher()
