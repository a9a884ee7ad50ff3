from __future__ import annotations

import random

import pytest
from cryptography.exceptions import InvalidTag

from protos.credential import Aead
from sidecar.core.aead import TAG_BYTES
from sidecar.core.frame import CLEAR, HEADER_BYTES, NONCE_OFFSET, PHASE_FLAG
from sidecar.core.path_keys import KeyLimits, OpeningKeys, SealingKeys

LIMITS = KeyLimits(datagrams=10, seconds=5.0)
SECRET, HEAD = bytes(32), 0xD3010000


def ends(limits: KeyLimits = LIMITS, aead: Aead = Aead.AES_256_GCM) -> tuple[SealingKeys, OpeningKeys]:
    return SealingKeys(aead, SECRET, HEAD, limits, 0.0), OpeningKeys(aead, SECRET, HEAD)


def sealed(keys: SealingKeys, number: int, now: float = 0.0) -> bytes:
    keys.use(1, now)
    clear = CLEAR.pack(keys.head, 7, number)
    out = bytearray(5 + TAG_BYTES)
    keys.encrypt_into(clear[NONCE_OFFSET:], b"frame", clear, out)
    return clear + out


def opens(keys: OpeningKeys, datagram: bytes) -> bool:
    clear, plain = datagram[:HEADER_BYTES], bytearray(5)
    (head, _, _) = CLEAR.unpack(clear)
    try:
        (keys.decrypt_into if head == keys.head else keys.open_other)(
            clear[NONCE_OFFSET:], datagram[HEADER_BYTES:], clear, plain
        )
    except InvalidTag:
        return False
    assert plain == b"frame"
    return True


def test_keys_change_by_age_and_by_volume_but_only_once_the_present_one_is_confirmed() -> None:
    sealing, _ = ends()
    sealing.use(50, 100.0)
    assert sealing.phase == 0, "nobody confirmed it"
    sealing.delivered(0.0)
    sealing.use(1, 100.0)
    assert sealing.phase == 0, "what left at the very moment it began may have left before"
    sealing.delivered(100.0)
    sealing.use(1, 100.0)
    assert (sealing.phase, sealing.head) == (1, HEAD | PHASE_FLAG << 16)
    sealing.use(1, 104.9)
    sealing.delivered(100.0)
    sealing.use(1, 106.0)
    assert sealing.phase == 1, "what left at the moment of the change confirms nothing"
    sealing.delivered(100.1)
    sealing.use(1, 104.9)
    assert sealing.phase == 1, "not old enough"
    sealing.use(1, 105.0)
    assert (sealing.phase, sealing.head) == (2, HEAD)
    sealing.delivered(105.1)
    sealing.use(9, 105.2)
    sealing.use(1, 105.2)
    assert sealing.phase == 3, "ten were sealed"


@pytest.mark.parametrize("aead", Aead)
def test_the_receiver_follows_and_takes_what_comes_late_of_the_phase_before(aead: Aead) -> None:
    sealing, opening = ends(aead=aead)
    late = sealed(sealing, 3)
    assert opens(opening, sealed(sealing, 4))
    for phase in range(1, 5):
        sealing.delivered(phase * 10.0)
        early = sealed(sealing, 100 * phase, 10.0 * phase + 6)
        overtaken = sealed(sealing, 100 * phase + 1, 10.0 * phase + 6)
        assert opens(opening, overtaken), "the first of the phase need not come first"
        assert opening.phase == sealing.phase == phase
        assert opens(opening, early)
        assert opens(opening, late)
        late = early


def test_what_is_two_phases_old_does_not_open() -> None:
    sealing, opening = ends()
    old = sealed(sealing, 1)
    for phase in (1, 2):
        sealing.delivered(phase * 10.0)
        assert opens(opening, sealed(sealing, 100 * phase, 10.0 * phase + 6))
    assert not opens(opening, old)


@pytest.mark.parametrize("number", [0, 5, 1000])
def test_what_is_not_authentic_changes_no_phase(number: int) -> None:
    sealing, opening = ends()
    assert opens(opening, sealed(sealing, 4))
    forged = CLEAR.pack(HEAD ^ PHASE_FLAG << 16, 7, number) + bytes(5 + TAG_BYTES)
    assert not opens(opening, forged)
    assert (opening.phase, opening.head) == (0, HEAD)
    assert opens(opening, sealed(sealing, 5))


@pytest.mark.parametrize("seed", range(20))
def test_nothing_is_lost_to_changes_of_keys_whatever_the_order(seed: int) -> None:
    """Datagrams out of order by up to thirty; what confirms a phase comes back late or not at all."""
    rng = random.Random(seed)
    sealing, opening = ends(KeyLimits(datagrams=100, seconds=1e9))
    on_the_way: list[tuple[float, bytes, float]] = []
    for number in range(3000):
        now = float(number)
        on_the_way.append((now + rng.uniform(0, 30), sealed(sealing, number, now), now))
        on_the_way.sort()
        while on_the_way and on_the_way[0][0] <= now:
            _, datagram, sent_at = on_the_way.pop(0)
            assert opens(opening, datagram)
            if rng.random() < 0.5:
                sealing.delivered(sent_at)
    assert sealing.phase > 20
