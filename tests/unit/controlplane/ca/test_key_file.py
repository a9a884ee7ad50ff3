"""A CA's key in a file: costly to guess at, and yet a file that others read too."""

from __future__ import annotations

import shutil
import subprocess
from typing import TYPE_CHECKING

import pytest
from cryptography.hazmat.primitives.serialization import (
    BestAvailableEncryption,
    Encoding,
    PrivateFormat,
    load_pem_private_key,
)

from plr.controlplane.ca import key_file
from plr.controlplane.ca.certificates import generate_key
from plr.controlplane.ca.key_file import clear_pem, encrypted_pem, is_encrypted, is_well_encrypted

if TYPE_CHECKING:
    from pathlib import Path

PASSPHRASE = b"correct horse"

pytestmark = pytest.mark.audit("sec-11")


def of_before(passphrase: bytes = PASSPHRASE) -> bytes:
    """A key as it was encrypted until now: 2,048 rounds of PBKDF2."""
    return generate_key().private_bytes(Encoding.PEM, PrivateFormat.PKCS8, BestAvailableEncryption(passphrase))


def test_the_key_comes_back_with_its_passphrase_only() -> None:
    key = generate_key()
    pem = encrypted_pem(key, PASSPHRASE)
    assert load_pem_private_key(pem, PASSPHRASE).public_key() == key.public_key()
    with pytest.raises(ValueError, match=r"\w"):
        load_pem_private_key(pem, b"wrong")


def test_every_file_has_a_salt_of_its_own() -> None:
    key = generate_key()
    assert encrypted_pem(key, PASSPHRASE) != encrypted_pem(key, PASSPHRASE)


def test_only_what_is_as_costly_to_guess_at_counts_as_well_encrypted(monkeypatch: pytest.MonkeyPatch) -> None:
    key = generate_key()
    well = encrypted_pem(key, PASSPHRASE)
    assert (is_encrypted(well), is_well_encrypted(well)) == (True, True)
    assert (is_encrypted(clear_pem(key)), is_well_encrypted(clear_pem(key))) == (False, False)
    assert (is_encrypted(of_before()), is_well_encrypted(of_before())) == (True, False)
    for cost, value in (("SCRYPT_N", 1 << 10), ("SCRYPT_R", 1), ("SCRYPT_P", 1)):
        with monkeypatch.context() as cheaper:
            cheaper.setattr(key_file, cost, value)
            cheap = encrypted_pem(key, PASSPHRASE)
        assert (is_encrypted(cheap), is_well_encrypted(cheap)) == (True, False)


@pytest.mark.parametrize("pem", [b"", b"x", b"-----BEGIN ENCRYPTED PRIVATE KEY-----\n?\n-----END"])
def test_what_is_no_key_is_not_well_encrypted(pem: bytes) -> None:
    assert not is_well_encrypted(pem)


@pytest.mark.skipif(shutil.which("openssl") is None, reason="needs OpenSSL's command line")
def test_openssl_opens_it_and_what_openssl_encrypts_as_well_counts(tmp_path: Path) -> None:
    path, back = tmp_path / "key.pem", tmp_path / "back.pem"
    key = generate_key()
    path.write_bytes(encrypted_pem(key, PASSPHRASE))
    password = f"pass:{PASSPHRASE.decode()}"
    costs = ["-scrypt", "-scrypt_N", str(1 << 14), "-scrypt_r", "8", "-scrypt_p", "16"]
    files = ["-in", str(path), "-passin", password, "-out", str(back), "-passout", password]
    subprocess.run(["openssl", "pkcs8", "-topk8", *costs, *files], check=True)
    assert load_pem_private_key(back.read_bytes(), PASSPHRASE).public_key() == key.public_key()
    assert is_well_encrypted(back.read_bytes())
