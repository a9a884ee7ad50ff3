from __future__ import annotations

import random
from typing import Any

import pytest
from cryptography.exceptions import InvalidTag

from lab.simulated.sessions import agree, session_of, with_credential
from plr.protos.base.errors import DecodeError
from plr.protos.model.ids import InterfaceId, Role
from plr.protos.trust.credential import Aead
from plr.sidecar.core.crypto.aead import TAG_BYTES
from plr.sidecar.core.crypto.key_schedule import proof_of_offer
from plr.sidecar.core.path.key_exchange import OTHER_OFFER_AFTER_S, KeyLimits
from plr.sidecar.core.path.keys import LATE_S, OpeningKeys, PathKeys, make_path_keys
from plr.sidecar.core.wire.frame import CLEAR, HEADER_BYTES, NONCE_OFFSET, PHASE_FLAG, KeyAnswer, KeyOffer
from tests.support.builders import peer

LIMITS = KeyLimits(datagrams=10, seconds=5.0)
HEAD = 0xD3010002
ROBOT, CLOUD = InterfaceId(1), InterfaceId(2)


def ends(limits: KeyLimits = LIMITS, aead: Aead = Aead.AES_256_GCM) -> tuple[PathKeys, PathKeys]:
    """The robot's end of a path, which leads, and the cloud's."""
    robot, cloud = session_of("robot-1", Role.ROBOT, 7, aead=aead), session_of("cloud-a", Role.CLOUD, 8, aead=aead)
    of_cloud = robot.admit(with_credential(peer("cloud-a", session=8), aead))
    of_robot = cloud.admit(with_credential(peer("robot-1", session=7, role=Role.ROBOT), aead))
    return (
        make_path_keys(of_cloud, ROBOT, CLOUD, limits, 0.0, leads=True),
        make_path_keys(of_robot, CLOUD, ROBOT, limits, 0.0, leads=False),
    )


def sealed(keys: PathKeys, number: int) -> bytes:
    sealing = keys.sealing
    sealing.sealed += 1
    clear = CLEAR.pack(sealing.head, 7, number)
    out = bytearray(5 + TAG_BYTES)
    sealing.encrypt_into(clear[NONCE_OFFSET:], b"frame", clear, out)
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


def exchange(robot: PathKeys, cloud: PathKeys, now: float, rng: random.Random) -> None:
    """An offer and its answer; nothing is sealed with the new keys yet."""
    offer = robot.offer(now, rng)
    assert offer is not None
    answer = cloud.answer(offer, now, rng)
    assert answer is not None
    assert robot.take(answer, now)


@pytest.mark.parametrize("aead", Aead)
def test_the_other_end_follows_with_the_first_datagram_and_takes_what_comes_late(aead: Aead) -> None:
    rng = random.Random(1)
    robot, cloud = ends(aead=aead)
    agree(robot, cloud, 0.0, rng)
    late = sealed(robot, 3)
    assert opens(cloud.opening, sealed(robot, 4))
    for phase in range(2, 6):
        exchange(robot, cloud, 10.0 * phase, rng)
        assert robot.sealing.phase == phase
        assert cloud.sealing.phase == phase - 1, "not before it is known that the robot has them"
        assert opens(robot.opening, sealed(cloud, phase)), "what is sealed with the keys before goes on"
        early = sealed(robot, 100 * phase)
        assert opens(cloud.opening, sealed(robot, 100 * phase + 1)), "the first of the phase need not come first"
        assert cloud.follow(10.0 * phase)
        assert not cloud.follow(10.0 * phase)
        assert cloud.sealing.phase == cloud.opening.phase == phase
        assert opens(cloud.opening, early)
        assert opens(cloud.opening, late)
        assert opens(robot.opening, sealed(cloud, 1000 + phase))
        assert robot.opening.phase == phase
        late = early


def test_the_head_tells_the_parity_of_the_phase() -> None:
    robot, cloud = ends()
    assert robot.sealing.head == cloud.opening.head
    before = robot.sealing.head
    agree(robot, cloud, 0.0, random.Random(1))
    assert robot.sealing.head == cloud.opening.head == before ^ PHASE_FLAG << 16


def test_new_keys_are_offered_at_once_and_then_by_age_and_by_volume() -> None:
    rng = random.Random(1)
    robot, cloud = ends()
    assert cloud.offer(1000.0, rng) is None, "it does not lead"
    first = robot.offer(0.0, rng)
    assert first is not None
    assert robot.offer(3.0, rng) == first, "the same until it is answered"
    agree(robot, cloud, 10.0, rng)
    assert robot.offer(14.9, rng) is None
    assert robot.offer(15.0, rng) is not None
    agree(robot, cloud, 15.0, rng)
    robot.sealing.sealed = 9
    assert robot.offer(15.1, rng) is None
    robot.sealing.sealed = 10
    assert robot.offer(15.1, rng) is not None
    agree(robot, cloud, 15.1, rng)
    cloud_sealed = robot.opening.first + 10
    robot.received.add(cloud_sealed, 15.2)
    assert robot.offer(15.2, rng) is not None, "what the other end sealed counts as well"


def test_the_keys_before_are_forgotten_after_a_while_and_those_of_the_sessions_at_once() -> None:
    rng = random.Random(1)
    robot, cloud = ends()
    of_the_sessions = sealed(robot, 1)
    agree(robot, cloud, 0.0, rng)
    assert not opens(cloud.opening, of_the_sessions)
    late = sealed(robot, 2)
    exchange(robot, cloud, 10.0, rng)
    assert opens(cloud.opening, sealed(robot, 3))
    assert cloud.follow(10.0)
    assert opens(cloud.opening, late)
    cloud.offer(10.0 + LATE_S, rng)
    assert not opens(cloud.opening, late)


@pytest.mark.parametrize("number", [0, 5, 1000])
@pytest.mark.parametrize("expects", [False, True])
def test_what_is_not_authentic_changes_no_phase(number: int, expects: bool) -> None:
    rng = random.Random(1)
    robot, cloud = ends()
    if expects:
        exchange(robot, cloud, 0.0, rng)
    head = cloud.opening.head
    forged = CLEAR.pack(head ^ PHASE_FLAG << 16, 7, number) + bytes(5 + TAG_BYTES)
    assert not opens(cloud.opening, forged)
    assert (cloud.opening.phase, cloud.opening.head) == (0, head)


def test_the_same_offer_has_the_same_answer_and_another_one_has_to_wait() -> None:
    rng = random.Random(1)
    robot, cloud = ends()
    offer = robot.offer(0.0, rng)
    assert offer is not None
    answer = cloud.answer(offer, 0.0, rng)
    assert answer is not None
    assert cloud.answer(offer, 0.1, rng) == answer
    again, _ = ends()
    other = again.offer(0.0, rng)
    assert other is not None
    assert cloud.answer(other, 0.1, rng) is None, "each costs some public-key work"
    newer = cloud.answer(other, OTHER_OFFER_AFTER_S, rng)
    assert newer is not None
    assert again.take(newer, 1.0), "as of a link that started over"
    with pytest.raises(DecodeError):
        robot.take(newer, 1.0)
    assert opens(cloud.opening, sealed(again, 1))


def test_offers_of_other_phases_and_answers_that_nobody_asked_for_are_nothing() -> None:
    rng = random.Random(1)
    robot, cloud = ends()
    offer = robot.offer(0.0, rng)
    assert offer is not None
    for phase in (0, 2, 2**32 - 1):
        assert cloud.answer(offer._replace(phase=phase), 0.0, rng) is None
    answer = cloud.answer(offer, 0.0, rng)
    assert answer is not None
    assert robot.answer(offer, 0.0, rng) is None, "it leads"
    assert not cloud.take(answer, 0.0), "it does not"
    assert not robot.take(answer._replace(phase=2), 0.0)
    assert robot.take(answer, 0.0)
    assert not robot.take(answer, 0.0)


def test_there_is_no_phase_after_the_last() -> None:
    rng = random.Random(1)
    robot, cloud = ends()
    agree(robot, cloud, 0.0, rng)
    for keys in (robot, cloud):
        keys._exchange.phase = keys.sealing.phase = keys.opening.phase = 2**32 - 1
    assert robot.offer(1000.0, rng) is None
    assert cloud.answer(KeyOffer(0, bytes(32), bytes(16)), 1000.0, rng) is None


def test_nothing_of_an_exchange_that_is_over_is_kept() -> None:
    rng = random.Random(1)
    robot, cloud = ends()
    before = robot._exchange._root
    agree(robot, cloud, 0.0, rng)
    for keys in (robot, cloud):
        assert keys._exchange._exchange is None
        assert keys._exchange._root != before
        assert keys.opening._previous is None


@pytest.mark.parametrize("key", [bytes(32), (1).to_bytes(32, "little")])
def test_keys_of_small_order_are_refused(key: bytes) -> None:
    rng = random.Random(1)
    robot, cloud = ends()
    root = cloud._pair.root(CLOUD, ROBOT)
    with pytest.raises(DecodeError, match="order"):
        cloud.answer(KeyOffer(1, key, proof_of_offer(root, 1, key)), 0.0, rng)
    offer = robot.offer(0.0, rng)
    assert offer is not None
    answer = cloud.answer(offer, 0.0, rng)
    assert answer is not None
    with pytest.raises(DecodeError):
        robot.take(answer._replace(key=key), 0.0)
    assert robot.take(answer, 0.0), "the good one still counts"


@pytest.mark.parametrize("part", ["key", "proof"])
def test_an_offer_that_was_changed_is_refused_and_spoils_nothing(part: str) -> None:
    rng = random.Random(1)
    robot, cloud = ends()
    offer = robot.offer(0.0, rng)
    assert offer is not None
    value = bytearray(getattr(offer, part))
    value[3] ^= 1
    key, said = (bytes(value), offer.proof) if part == "key" else (offer.key, bytes(value))
    with pytest.raises(DecodeError, match="offer"):
        cloud.answer(KeyOffer(offer.phase, key, said), 0.0, rng)
    answer = cloud.answer(offer, 0.0, rng)
    assert answer is not None
    assert robot.take(answer, 0.0)


@pytest.mark.parametrize("part", ["key", "proof"])
def test_an_answer_that_was_changed_is_refused(part: str) -> None:
    rng = random.Random(1)
    robot, cloud = ends()
    offer = robot.offer(0.0, rng)
    assert offer is not None
    answer = cloud.answer(offer, 0.0, rng)
    assert answer is not None
    value = bytearray(getattr(answer, part))
    value[3] ^= 1
    key, said = (bytes(value), answer.proof) if part == "key" else (answer.key, bytes(value))
    with pytest.raises(DecodeError):
        robot.take(KeyAnswer(answer.phase, key, said), 0.0)


@pytest.mark.parametrize("seed", range(20))
def test_nothing_is_lost_to_changes_of_keys_whatever_the_order(seed: int) -> None:
    """Datagrams out of order by up to thirty; offers and answers come late, twice, or not at all."""
    rng = random.Random(seed)
    robot, cloud = ends(KeyLimits(datagrams=100, seconds=1e9))
    agree(robot, cloud, 0.0, rng)
    on_the_way: list[tuple[float, int, PathKeys, bytes, Any]] = []
    for number in range(1, 3000):
        now = number * 0.1
        for keys, other in ((robot, cloud), (cloud, robot)):
            said: Any = robot.offer(now, rng) if keys is robot and rng.random() < 0.2 else None
            copies = rng.choice((0, 1, 1, 2)) if said is not None else 1
            datagram = sealed(keys, 2 * number)
            on_the_way += [(now + rng.uniform(0, 3), number, other, datagram, said) for _ in range(copies)]
        on_the_way.sort(key=lambda one: one[0])
        while on_the_way and on_the_way[0][0] <= now:
            _, at, keys, datagram, said = on_the_way.pop(0)
            assert opens(keys.opening, datagram)
            keys.received.add(2 * at, now)
            if keys is cloud:
                cloud.follow(now)
                answer = cloud.answer(said, now, rng) if isinstance(said, KeyOffer) else None
                if answer is not None and rng.random() < 0.8:
                    on_the_way.append((now + rng.uniform(0, 3), number, robot, sealed(cloud, 2 * number + 1), answer))
            elif said is not None:
                robot.take(said, now)
    assert robot.sealing.phase > 10


@pytest.mark.audit("sec-9")
@pytest.mark.parametrize("other", [False, True])
def test_an_offer_is_not_answered_once_more_when_its_keys_have_opened_something(*, other: bool) -> None:
    """Nobody may have read that yet, as when it was malformed: expected again, the key would open one phase too far."""
    rng = random.Random(1)
    robot, cloud = ends()
    offer = robot.offer(0.0, rng)
    assert offer is not None
    answer = cloud.answer(offer, 0.0, rng)
    assert answer is not None
    if other:
        key = bytes(31) + b"\x09"
        offer = KeyOffer(1, key, proof_of_offer(robot._exchange._root, 1, key))
    assert robot.take(answer, 0.0)
    assert opens(cloud.opening, sealed(robot, 4))
    assert cloud.answer(offer, OTHER_OFFER_AFTER_S, rng) is None
    robot.sealing.head ^= PHASE_FLAG << 16
    assert not opens(cloud.opening, sealed(robot, 5))
    assert cloud.follow(2.0)
    assert not cloud.follow(2.0)
    assert cloud.opening.phase == cloud.sealing.phase == 1
