"""The cipher that seals nothing works in benchmarks, and nowhere else."""

from __future__ import annotations

from pathlib import Path

from bench.null_cipher import NullCipher, null_cipher
from plr.protos.trust.credential import Aead
from plr.sidecar.core.crypto import aead

ROOT = Path(__file__).parents[3]


def test_within_its_block_every_cipher_is_null() -> None:
    with null_cipher():
        cipher = aead.make_cipher(Aead.AES_256_GCM, bytes(32))
        sealed, plain = memoryview(bytearray(5 + aead.TAG_BYTES)), bytearray(5)
        cipher.encrypt_into(bytes(12), b"frame", b"", sealed)
        cipher.decrypt_into(bytes(12), sealed, b"", plain)
        assert bytes(sealed[:5]) == plain == b"frame"
    assert not isinstance(aead.make_cipher(Aead.AES_256_GCM, bytes(32)), NullCipher)


def test_no_program_knows_of_it() -> None:
    for package in ("protos", "sidecar", "controlplane", "deploy"):
        for path in (ROOT / package).rglob("*.py"):
            assert "null_cipher" not in path.read_text(encoding="utf-8"), path
            assert "NullCipher" not in path.read_text(encoding="utf-8"), path
