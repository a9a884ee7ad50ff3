from __future__ import annotations

import pytest
from cryptography.exceptions import InvalidTag

from plr.protos.trust.credential import Aead
from plr.sidecar.core.crypto.aead import KEY_BYTES, NONCE_BYTES, TAG_BYTES, choose, make_cipher

KEY, NONCE, CLEAR = bytes(range(KEY_BYTES)), bytes(range(NONCE_BYTES)), b"clear"
GOLDENS = {
    Aead.AES_256_GCM: "2170b776a0851f9095d278546ee7b5a0d7cdeee63a",
    Aead.CHACHA20_POLY1305: "ef89696d4cea5fc6db088eb68a0066e7abb2c6348d",
}


@pytest.mark.parametrize("aead", Aead)
def test_what_is_sealed_where_it_lies_opens_elsewhere(aead: Aead) -> None:
    cipher = make_cipher(aead, KEY)
    buffer = memoryview(bytearray(b"frame" + bytes(TAG_BYTES)))
    assert cipher.encrypt_into(NONCE, buffer[:5], CLEAR, buffer) == len(buffer)
    plain = bytearray(5)
    cipher.decrypt_into(NONCE, buffer, CLEAR, plain)
    assert plain == b"frame"


@pytest.mark.parametrize("aead", Aead)
def test_nothing_changed_opens(aead: Aead) -> None:
    sealed = bytearray(5 + TAG_BYTES)
    make_cipher(aead, KEY).encrypt_into(NONCE, b"frame", CLEAR, sealed)
    wrong = [
        (KEY[::-1], NONCE, bytes(sealed), CLEAR),
        (KEY, NONCE[::-1], bytes(sealed), CLEAR),
        (KEY, NONCE, bytes(sealed), b"other"),
        *(
            (KEY, NONCE, bytes(sealed[:at]) + bytes([sealed[at] ^ 1]) + bytes(sealed[at + 1 :]), CLEAR)
            for at in range(21)
        ),
    ]
    for key, nonce, data, clear in wrong:
        with pytest.raises(InvalidTag):
            make_cipher(aead, key).decrypt_into(nonce, data, clear, bytearray(5))


@pytest.mark.parametrize("aead", Aead)
def test_the_bytes_are_those_of_the_standard(aead: Aead) -> None:
    sealed = bytearray(5 + TAG_BYTES)
    make_cipher(aead, KEY).encrypt_into(NONCE, b"frame", CLEAR, sealed)
    assert sealed.hex() == GOLDENS[aead]


def test_aes_only_where_both_are_quick_at_it() -> None:
    aes, chacha = Aead.AES_256_GCM, Aead.CHACHA20_POLY1305
    assert [choose(*pair) for pair in ((aes, aes), (aes, chacha), (chacha, aes), (chacha, chacha))] == [
        aes,
        chacha,
        chacha,
        chacha,
    ]
