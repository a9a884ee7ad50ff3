"""Encodes a CA's key for a file: PKCS #8 in PEM, encrypted with scrypt and AES-256-CBC (PBES2), or unencrypted.

    EncryptedPrivateKeyInfo ::= SEQUENCE {                                 RFC 5958
        SEQUENCE { PBES2, SEQUENCE {                                       RFC 8018
            SEQUENCE { scrypt, SEQUENCE { salt, N, r, p } }                RFC 7914
            SEQUENCE { aes256-CBC, iv } } }
        OCTET STRING }                                                     the key's PrivateKeyInfo, padded (PKCS #7)

The library reads this, and so does OpenSSL (`openssl pkey -in key.pem`). But the library writes PKCS #8 with nothing
better than 2,048 rounds of PBKDF2. So there are a few bytes of DER here.
"""

from __future__ import annotations

import base64
import binascii
import os
import re
from typing import TYPE_CHECKING

from cryptography.hazmat.primitives.ciphers import Cipher, algorithms, modes
from cryptography.hazmat.primitives.kdf.scrypt import Scrypt
from cryptography.hazmat.primitives.padding import PKCS7
from cryptography.hazmat.primitives.serialization import Encoding, NoEncryption, PrivateFormat

if TYPE_CHECKING:
    from cryptography.hazmat.primitives.asymmetric import ec

SCRYPT_N = 1 << 14
"""With r this takes 16 MiB for each guess, the most that OpenSSL's command line opens: it refuses 32 MiB."""

SCRYPT_R = 8

SCRYPT_P = 16
"""Passes over those 16 MiB: 0.6 s of a processor where this was written, 1,500 times as much as before.

This is three times the minimum that OWASP asks for with this N and r (p = 5).
"""

_SALT_BYTES = 16
_KEY_BYTES = 32
_BLOCK_BITS = 128
_PEM_COLUMNS = 64

_INTEGER, _OCTETS, _OID, _SEQUENCE = 0x02, 0x04, 0x06, 0x30
_PBES2 = bytes.fromhex("2a864886f70d01050d")  # 1.2.840.113549.1.5.13
_SCRYPT = bytes.fromhex("2b06010401da47040b")  # 1.3.6.1.4.1.11591.4.11
_AES256_CBC = bytes.fromhex("60864801650304012a")  # 2.16.840.1.101.3.4.1.42

_BEGIN, _END = b"-----BEGIN ENCRYPTED PRIVATE KEY-----", b"-----END ENCRYPTED PRIVATE KEY-----"


def clear_pem(key: ec.EllipticCurvePrivateKey) -> bytes:
    """Return the key in PEM, not encrypted."""
    return key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption())


def encrypted_pem(key: ec.EllipticCurvePrivateKey, passphrase: bytes) -> bytes:
    """Return the key in PEM, encrypted; this takes as long as one guess."""
    salt, iv = os.urandom(_SALT_BYTES), os.urandom(_BLOCK_BITS // 8)
    derived = Scrypt(salt=salt, length=_KEY_BYTES, n=SCRYPT_N, r=SCRYPT_R, p=SCRYPT_P).derive(passphrase)
    padder = PKCS7(_BLOCK_BITS).padder()
    clear = padder.update(key.private_bytes(Encoding.DER, PrivateFormat.PKCS8, NoEncryption())) + padder.finalize()
    encryptor = Cipher(algorithms.AES256(derived), modes.CBC(iv)).encryptor()
    kdf = _tlv(_OID, _SCRYPT) + _tlv(_SEQUENCE, _tlv(_OCTETS, salt) + _costs())
    cipher = _tlv(_OID, _AES256_CBC) + _tlv(_OCTETS, iv)
    scheme = _tlv(_OID, _PBES2) + _tlv(_SEQUENCE, _tlv(_SEQUENCE, kdf) + _tlv(_SEQUENCE, cipher))
    data = encryptor.update(clear) + encryptor.finalize()
    return _pem(_tlv(_SEQUENCE, _tlv(_SEQUENCE, scheme) + _tlv(_OCTETS, data)))


def is_encrypted(pem: bytes) -> bool:
    """Return whether the key needs a passphrase."""
    return b"ENCRYPTED" in pem


def is_well_encrypted(pem: bytes) -> bool:
    """Return whether the key is encrypted as `encrypted_pem` does it today, so that a guess costs as much."""
    body = pem.partition(_BEGIN)[2].partition(_END)[0]
    try:
        der = base64.b64decode(b"".join(body.split()), validate=True)
    except binascii.Error:
        return False
    # The salt has 8 bytes if OpenSSL wrote the file.
    kdf = re.escape(_tlv(_OID, _SCRYPT)) + rb"\x30.\x04[\x08-\x20].{8,32}" + re.escape(_costs())
    return re.search(kdf, der, re.DOTALL) is not None


def _costs() -> bytes:
    return b"".join(_tlv(_INTEGER, _number(cost)) for cost in (SCRYPT_N, SCRYPT_R, SCRYPT_P))


def _number(value: int) -> bytes:
    # One bit more than the value needs: the first bit is the sign.
    return value.to_bytes(value.bit_length() // 8 + 1, "big")


def _tlv(tag: int, content: bytes) -> bytes:
    """Return one DER element: its tag, the length of the content, and the content."""
    size = len(content)
    if size < 0x80:
        return bytes((tag, size)) + content
    length = size.to_bytes((size.bit_length() + 7) // 8, "big")
    return bytes((tag, 0x80 | len(length))) + length + content


def _pem(der: bytes) -> bytes:
    text = base64.b64encode(der)
    lines = [text[at : at + _PEM_COLUMNS] for at in range(0, len(text), _PEM_COLUMNS)]
    return b"\n".join((_BEGIN, *lines, _END)) + b"\n"
