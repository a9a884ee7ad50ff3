"""A cipher that only copies, for measuring what sealing costs. No program of ours imports it but benchmarks.

It takes the place of the AEAD where that is made, in this process; no configuration leads here.
"""

from __future__ import annotations

import contextlib
from typing import TYPE_CHECKING

from sidecar.core import aead

if TYPE_CHECKING:
    from collections.abc import Iterator

    from cryptography.utils import Buffer

    from protos.credential import Aead
    from sidecar.core.aead import Cipher

_NO_TAG = bytes(aead.TAG_BYTES)


class NullCipher:
    """Copies, in place of encrypting and authenticating."""

    def encrypt_into(self, nonce: Buffer, data: Buffer, associated_data: Buffer, buf: Buffer, /) -> int:
        """As a Cipher's."""
        view = memoryview(buf)
        view[: -aead.TAG_BYTES] = data
        view[-aead.TAG_BYTES :] = _NO_TAG
        return len(view)

    def decrypt_into(self, nonce: Buffer, data: Buffer, associated_data: Buffer, buf: Buffer, /) -> int:
        """As a Cipher's, but of whatever comes."""
        memoryview(buf)[:] = memoryview(data)[: -aead.TAG_BYTES]
        return len(buf)


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
