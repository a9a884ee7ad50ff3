"""The values of docs/develop/protocol-vectors.json, with our code and with one written from protocol.md alone.

What is called `independent` here uses nothing of ours: X25519, ECDSA and the two AEADs of `cryptography`, HMAC and
SHA-256 of the standard library. Where the page is wrong or silent, it cannot be right.
"""

from __future__ import annotations

import hashlib
import hmac
import json
import random
import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from cryptography import x509
from cryptography.exceptions import InvalidTag
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.asymmetric.x25519 import X25519PrivateKey, X25519PublicKey
from cryptography.hazmat.primitives.ciphers.aead import AESGCM, ChaCha20Poly1305
from cryptography.hazmat.primitives.serialization import Encoding

from lab.simulated.sessions import seal
from plr.protos.base.errors import DecodeError
from plr.protos.model.ids import PROTOCOL_VERSION, InterfaceId, InterfaceName, NodeName, Role, ServiceName
from plr.protos.model.members import Candidate, CandidateKind
from plr.protos.trust.candidate_signature import signed_bytes, verify_candidates
from plr.protos.trust.credential import Aead, SessionCredential, decode_credential, session_number, verify
from plr.protos.trust.identity import Trust
from plr.protos.trust.pair_token import pair_token
from plr.sidecar.core.base.request_id import OBSERVED_ONE_IN
from plr.sidecar.core.base.values import Priority, RejectReason, RequestId
from plr.sidecar.core.crypto import session
from plr.sidecar.core.crypto.key_schedule import pair_keys
from plr.sidecar.core.engine.peers import RESTART_GAP_S
from plr.sidecar.core.engine.verification_budget import ALL_LOOKS_AT_ONCE, ALL_LOOKS_PER_S, LOOKS_PER_S
from plr.sidecar.core.link import path_table
from plr.sidecar.core.message import reassembly
from plr.sidecar.core.path import address, introductions, key_exchange
from plr.sidecar.core.path.key_exchange import DEFAULT_LIMITS
from plr.sidecar.core.path.keys import LATE_S, MAX_FAILED, PathKeys, make_path_keys
from plr.sidecar.core.transfer import outbox
from plr.sidecar.core.wire import fec, frame, introduction, messages
from plr.sidecar.core.wire.frame import Header

if TYPE_CHECKING:
    from collections.abc import Callable

    from plr.sidecar.core.crypto.key_schedule import PairKeys

DOCS = Path(__file__).parents[2] / "docs" / "develop"
PAGE = (DOCS / "protocol.md").read_text(encoding="utf-8")
VECTORS: dict[str, Any] = json.loads((DOCS / "protocol-vectors.json").read_text(encoding="utf-8"))
GIVEN: dict[str, Any] = VECTORS["given"]
ROLES = ("robot", "cloud")

Values = dict[str, str]


def given(*keys: str) -> bytes:
    """What stands under these keys, which is hexadecimal."""
    value: Any = GIVEN
    for key in keys:
        value = value[key]
    return bytes.fromhex(value)


# -- written from the page --------------------------------------------------------------------------------------------


def u8(value: int) -> bytes:
    return value.to_bytes(1, "big")


def u16(value: int) -> bytes:
    return value.to_bytes(2, "big")


def u32(value: int) -> bytes:
    return value.to_bytes(4, "big")


def u64(value: int) -> bytes:
    return value.to_bytes(8, "big")


def extract(salt: bytes, ikm: bytes) -> bytes:
    return hmac.new(salt, ikm, hashlib.sha256).digest()


def expand(prk: bytes, info: bytes, size: int = 32) -> bytes:
    return hmac.new(prk, info + u8(1), hashlib.sha256).digest()[:size]


def hkdf(salt: bytes, ikm: bytes, info: bytes) -> bytes:
    return expand(extract(salt, ikm), info)


def dh(private: bytes, public: bytes) -> bytes:
    return X25519PrivateKey.from_private_bytes(private).exchange(X25519PublicKey.from_public_bytes(public))


def public_of(private: bytes) -> bytes:
    return X25519PrivateKey.from_private_bytes(private).public_key().public_bytes_raw()


def cipher_of(aead: int, key: bytes) -> AESGCM | ChaCha20Poly1305:
    return AESGCM(key) if aead == 1 else ChaCha20Poly1305(key)


def clear_of(flags: int, sender: int, receiver: int, number_of_session: int, number: int) -> bytes:
    return u8(0xD3) + u8(flags) + u8(sender) + u8(receiver) + u64(number_of_session) + u64(number)


def multiply(one: int, other: int) -> int:
    """In GF(256) with polynomial 0x11D."""
    product = 0
    while other:
        if other & 1:
            product ^= one
        one <<= 1
        if one & 0x100:
            one ^= 0x11D
        other >>= 1
    return product


def power(exponent: int) -> int:
    value = 1
    for _ in range(exponent % 255):
        value = multiply(value, 2)
    return value


def inverse_of(matrix: list[list[int]]) -> list[list[int]]:
    """Gauss and Jordan's."""
    size = len(matrix)
    rows = [row + [int(column == place) for column in range(size)] for place, row in enumerate(matrix)]
    for place in range(size):
        pivot = next(row for row in range(place, size) if rows[row][place])
        rows[place], rows[pivot] = rows[pivot], rows[place]
        factor = next(value for value in range(256) if multiply(value, rows[place][place]) == 1)
        rows[place] = [multiply(factor, value) for value in rows[place]]
        for row in range(size):
            if row != place and rows[row][place]:
                by = rows[row][place]
                rows[row] = [one ^ multiply(by, other) for one, other in zip(rows[row], rows[place], strict=True)]
    return [row[size:] for row in rows]


def repair_row(sources: list[bytes], row: int) -> bytes:
    m = len(sources)
    v = [[1, *([0] * (m - 1))]] + [[power((t - 1) * column) for column in range(m)] for t in range(1, 2 * m)]
    upper = inverse_of(v[:m])
    factors = [0] * m
    for column in range(m):
        for inner in range(m):
            factors[column] ^= multiply(v[m + row][inner], upper[inner][column])
    out = bytearray(len(sources[0]))
    for factor, source in zip(factors, sources, strict=True):
        for place, value in enumerate(source):
            out[place] ^= multiply(factor, value)
    return bytes(out)


def independent_credential(role: str, aead: int) -> tuple[bytes, bytes, bytes]:
    """The session (8 bytes), the identity and the credential of a role."""
    name, certificate = GIVEN[role]["name"].encode(), given(role, "certificate")
    number = ROLES.index(role) + 1
    key = public_of(given(role, "session private key"))
    session_of = hashlib.sha256(b"plr session number\0" + u8(number) + u8(len(name)) + name + key).digest()[:8]
    head = u8(1) + u8(number) + u8(aead) + u8(len(name)) + session_of + u64(GIVEN[role]["incarnation"]) + key
    signature = given(role, "credential signature", str(aead))
    signed = head + u16(len(certificate)) + name + certificate
    signer = x509.load_der_x509_certificate(certificate).public_key()
    assert isinstance(signer, ec.EllipticCurvePublicKey)
    signer.verify(signature, b"plr session credential\0" + signed, ec.ECDSA(hashes.SHA256()))
    return session_of, head + u16(0) + name, signed + u8(len(signature)) + signature


def independent(aead: int) -> Values:
    """All values, where both ends prefer this AEAD."""
    out: dict[str, bytes] = {}
    robot, cloud = (independent_credential(role, aead) for role in ROLES)
    for role, (number, identity, credential) in zip(ROLES, (robot, cloud), strict=True):
        out[f"{role}: session"], out[f"{role}: identity"], out[f"{role}: credential"] = number, identity, credential
    cloud_name = GIVEN["cloud"]["name"].encode()
    token = expand(given("robot", "token"), b"plr 2 pair token" + u8(2) + cloud_name, 16)
    out["pair token"], out["hello id"] = token, expand(token, b"plr 2 hello id", 8)

    private_e, private_f = given("robot", "ephemeral private key"), given("cloud", "ephemeral private key")
    own_e, own_f = given("robot", "session private key"), given("cloud", "session private key")
    e, f, robot_key, cloud_key = (public_of(one) for one in (private_e, private_f, own_e, own_f))
    info = b"".join(u16(len(identity)) + identity for identity in (cloud[1], robot[1]))
    secret = hkdf(b"plr 2 pair", dh(own_e, cloud_key), info)
    assert dh(own_e, cloud_key) == dh(own_f, robot_key)
    out["pair secret"] = secret
    at_robot, at_cloud = GIVEN["robot"]["interface"], GIVEN["cloud"]["interface"]
    root = expand(secret, b"plr 3 path" + u8(at_cloud) + u8(at_robot))
    offer = u32(1) + e + expand(root, b"plr 3 offer" + u32(1) + e, 16)
    shared = dh(private_e, f) + dh(private_e, cloud_key) + dh(own_e, f)
    assert shared == dh(private_f, e) + dh(own_f, e) + dh(private_f, robot_key)
    fresh = hkdf(root, shared, b"plr 3 phase" + u32(1) + e + f)
    out["offer"], out["answer"] = offer, u32(1) + f + expand(fresh, b"plr 3 proof", 16)
    for phase, of_phase in enumerate((root, fresh)):
        out[f"root {phase}"] = of_phase
        for role, direction in (("cloud", 0), ("robot", 1)):
            key = expand(of_phase, b"plr 3 key" + u8(direction))
            out[f"key {phase} of the {role}"] = key
            sender, receiver = (at_cloud, at_robot) if role == "cloud" else (at_robot, at_cloud)
            number_of_session = int.from_bytes((cloud if role == "cloud" else robot)[0], "big")
            number = GIVEN["packet number"] + phase
            clear = clear_of(1 | (phase % 2) << 1, sender, receiver, number_of_session, number)
            plain = given("frames", str(phase))
            out[f"datagram {phase} of the {role}"] = clear + cipher_of(aead, key).encrypt(clear[8:], plain, clear)

    clear = clear_of(5, at_robot, at_cloud, int.from_bytes(robot[0], "big"), GIVEN["packet number"])
    clear += out["hello id"]
    key = expand(token, b"plr 2 introduction" + robot[0] + u8(at_robot) + u8(at_cloud) + cloud_name)
    plain = u64(GIVEN["probe id"]) + offer + robot[2]
    out["introduction"] = clear + ChaCha20Poly1305(key).encrypt(clear[8:20], plain, clear)
    return {name: value.hex() for name, value in out.items()} | independent_of_aead(robot[0])


def independent_of_aead(number_of_session: bytes) -> Values:
    said = GIVEN["candidates"]
    kinds = {"host": 1, "srflx": 2}
    signed = b"plr candidates\0" + number_of_session + u64(said["serial"]) + u16(len(said["list"]))
    for one in said["list"]:
        signed += u8(one["interface number"]) + u8(kinds[one["kind"]]) + u16(one["port"])
        signed += u8(len(one["interface"])) + one["interface"].encode() + u8(len(one["host"])) + one["host"].encode()
    request = given("request id")
    service, kind = b"/echo", b"t/srv/Echo"
    sources = [bytes.fromhex(one) for one in GIVEN["source symbols"]]
    return {
        "candidates": signed.hex(),
        "request": (
            u8(1) + request + u8(2) + u8(1) + u32(150_000) + u32(2_000_000) + u16(5) + service + u16(10) + kind + b"pay"
        ).hex(),
        "response": (u8(2) + request + u8(2) + u32(1234) + b"load").hex(),
        "rejection": (u8(3) + request + u8(2) + u8(4) + u16(4) + b"full").hex(),
        "cancel": (u8(4) + request + u8(0)).hex(),
        "acknowledgement": (
            u8(3) + u64(100) + u32(2500) + u8(2) + u16(100 - 97) + u16(0) + u16(95 - 90) + u16(97 - 95 - 2)
        ).hex(),
        "repair symbols": "".join(repair_row(sources, row).hex() for row in range(len(sources))),
    }


# -- ours -------------------------------------------------------------------------------------------------------------


class Given(random.Random):
    """Draws what it is told."""

    def __init__(self, drawn: bytes) -> None:
        super().__init__()
        self._drawn = drawn

    def randbytes(self, n: int) -> bytes:
        assert n == len(self._drawn)
        return self._drawn


def our_credential(role: str, aead: int) -> SessionCredential:
    name, its_role = NodeName(GIVEN[role]["name"]), Role.ROBOT if role == "robot" else Role.CLOUD
    key = session.public_key(given(role, "session private key"))
    credential = SessionCredential(
        name, its_role, session_number(name, its_role, key), GIVEN[role]["incarnation"], key, Aead(aead),
        given(role, "certificate"), given(role, "credential signature", str(aead)),
    )  # fmt: skip
    trust = Trust(x509.load_der_x509_certificate(given("CA")).public_bytes(Encoding.PEM))
    verify(credential, lambda certificate: trust.check(certificate, GIVEN["time"]))
    assert decode_credential(credential.encode()) == credential
    return credential


def our_ends(aead: int) -> tuple[PairKeys, PathKeys, PathKeys]:
    robot, cloud = (our_credential(role, aead) for role in ROLES)
    private = [X25519PrivateKey.from_private_bytes(given(role, "session private key")) for role in ROLES]
    of_cloud = pair_keys(private[0], private[1].public_key(), robot, cloud)
    of_robot = pair_keys(private[1], private[0].public_key(), cloud, robot)
    at_robot, at_cloud = (InterfaceId(GIVEN[role]["interface"]) for role in ROLES)
    assert of_cloud.secret == of_robot.secret
    return (
        of_cloud,
        make_path_keys(of_cloud, at_robot, at_cloud, DEFAULT_LIMITS, 0.0, leads=True),
        make_path_keys(of_robot, at_cloud, at_robot, DEFAULT_LIMITS, 0.0, leads=False),
    )


def ours(aead: int) -> Values:
    robot, cloud = (our_credential(role, aead) for role in ROLES)
    pair, leader, follower = our_ends(aead)
    out: dict[str, bytes] = {}
    for role, credential in zip(ROLES, (robot, cloud), strict=True):
        out[f"{role}: session"] = credential.session.to_bytes(8, "big")
        out[f"{role}: identity"], out[f"{role}: credential"] = credential.identity, credential.encode()
    token = pair_token(given("robot", "token"), cloud.name, Role.CLOUD)
    out["pair token"], out["hello id"] = token, introduction.hello_id(token)
    out["pair secret"] = pair.secret
    at_robot, at_cloud = (InterfaceId(GIVEN[role]["interface"]) for role in ROLES)

    def note(phase: int, root: bytes) -> None:
        out[f"root {phase}"] = root
        out[f"key {phase} of the robot"], out[f"key {phase} of the cloud"] = (
            pair.sealing_key(root),
            pair.opening_key(root),
        )
        number, flags, plain = GIVEN["packet number"] + phase, 1 | (phase % 2) << 1, given("frames", str(phase))
        from_robot = Header(at_robot, at_cloud, robot.session, number, flags)
        from_cloud = Header(at_cloud, at_robot, cloud.session, number, flags)
        out[f"datagram {phase} of the robot"] = seal(leader.sealing, from_robot, plain)
        out[f"datagram {phase} of the cloud"] = seal(follower.sealing, from_cloud, plain)

    note(0, pair.root(at_robot, at_cloud))
    offer = leader.offer(0.0, Given(given("robot", "ephemeral private key")))
    assert offer is not None
    answer = follower.answer(offer, 0.0, Given(given("cloud", "ephemeral private key")))
    assert answer is not None
    assert leader.take(answer, 0.0)
    follower.opening.advance(0)
    assert follower.follow(0.0)
    out["offer"], out["answer"] = frame.encode_key_offer(offer)[1:], frame.encode_key_answer(answer)[1:]
    note(1, leader._exchange._root)
    header = Header(at_robot, at_cloud, robot.session, GIVEN["packet number"])
    out["introduction"] = introduction.encode_introduction(
        header, token, cloud.name, GIVEN["probe id"], robot.encode(), offer
    )
    return {name: value.hex() for name, value in out.items()} | ours_of_no_aead(robot)


def ours_of_no_aead(robot: SessionCredential) -> Values:
    said = GIVEN["candidates"]
    candidates = tuple(
        Candidate(
            InterfaceId(one["interface number"]), InterfaceName(one["interface"]), CandidateKind(one["kind"]),
            (one["host"], one["port"]),
        )
        for one in said["list"]
    )  # fmt: skip
    verify_candidates(robot.certificate, robot.session, said["serial"], candidates, bytes.fromhex(said["signature"]))
    rid = RequestId(given("request id"))
    sources = [bytes.fromhex(one) for one in GIVEN["source symbols"]]
    service = ServiceName("/echo")
    said_messages: dict[str, messages.Message] = {
        "request": messages.RequestMessage(rid, 2, Priority.NORMAL, 0.15, 2.0, service, "t/srv/Echo", b"pay"),
        "response": messages.ResponseMessage(rid, 2, 0.001234, b"load"),
        "rejection": messages.RejectionMessage(rid, 2, RejectReason.OVERLOADED, "full"),
        "cancel": messages.CancelMessage(rid),
    }
    encoded = {name: b"".join(messages.encode_message(one)[:2]).hex() for name, one in said_messages.items()}
    return encoded | {
        "candidates": signed_bytes(robot.session, said["serial"], candidates).hex(),
        "acknowledgement": frame.encode_ack([(97, 100), (90, 95)], 0.0025).hex(),
        "repair symbols": "".join(fec.encode(sources, row).hex() for row in range(len(sources))),
    }


# -- all three are the same -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("aead", [1, 2])
@pytest.mark.parametrize("how", [ours, independent])
def test_the_vectors(how: Callable[[int], Values], aead: int) -> None:
    expected = VECTORS["expected"][str(aead)]
    assert how(aead) == expected


@pytest.mark.parametrize("aead", [1, 2])
def test_what_the_page_makes_is_read_by_us(aead: int) -> None:
    made = {name: bytes.fromhex(value) for name, value in independent(aead).items()}
    told = introduction.open_introduction(
        frame.decode_header(made["introduction"]), memoryview(made["introduction"]), made["pair token"],
        NodeName(GIVEN["cloud"]["name"]),
    )  # fmt: skip
    assert told.probe_id == GIVEN["probe id"]
    assert told.offer is not None
    assert told.credential == our_credential("robot", aead)
    _, _, follower = our_ends(aead)
    datagram = made["datagram 0 of the robot"]
    plain = bytearray(len(datagram) - 36)
    follower.opening.decrypt_into(datagram[8:20], datagram[20:], datagram[:20], plain)
    assert bytes(plain) == given("frames", "0")
    assert follower.answer(told.offer, 0.0, Given(given("cloud", "ephemeral private key"))) is not None
    datagram = made["datagram 1 of the robot"]
    plain = bytearray(len(datagram) - 36)
    follower.opening.open_other(datagram[8:20], datagram[20:], datagram[:20], plain)
    assert bytes(plain) == given("frames", "1")


def test_the_root_before_and_both_session_keys_do_not_give_the_next_root() -> None:
    """They are learnt later, from two memories: what is missing is the exchange of the two new keys, long forgotten."""
    values = {name: bytes.fromhex(value) for name, value in independent(1).items()}
    e, f = values["offer"][4:36], values["answer"][4:36]
    own_e, cloud_key = given("robot", "session private key"), public_of(given("cloud", "session private key"))
    own_f, robot_key = given("cloud", "session private key"), public_of(own_e)
    datagram = values["datagram 1 of the robot"]
    # Two of the three exchanges are known; all that can be computed stands in for the third.
    for guess in (dh(own_e, cloud_key), dh(own_e, f), dh(own_f, e), dh(own_f, robot_key), bytes(32)):
        root = hkdf(values["root 0"], guess + dh(own_f, e) + dh(own_e, f), b"plr 3 phase" + u32(1) + e + f)
        with pytest.raises(InvalidTag):
            cipher_of(1, expand(root, b"plr 3 key" + u8(1))).decrypt(datagram[8:20], datagram[20:], datagram[:20])


# -- the tables of the page -------------------------------------------------------------------------------------------


def table(heading: str) -> list[list[str]]:
    text = PAGE.split(f"\n{heading}\n", 1)[1].split("\n#", 1)[0]
    rows = [line.strip("|\n").split("|") for line in text.splitlines() if line.startswith("|")]
    return [[cell.strip() for cell in row] for row in rows[2:]]


def test_the_table_of_frames_names_the_types_of_the_code() -> None:
    of_page = {row[1]: int(row[0]) for row in table("## Frames")}
    drawing = (frame.__doc__ or "").split("Frames, each a type byte and then::", 1)[1].split("\n\nA message", 1)[0]
    of_code = {name: int(number) for name, number in re.findall(r"^    ([A-Z_]+) +(\d+) ", drawing, re.MULTILINE)}
    assert of_page == of_code
    body = bytes(300)
    for name, number in of_page.items():
        if name in {"PADDING", "ACK", "FRAGMENT", "REPAIR"}:
            continue
        plain = bytes([number]) + body[: {"CLOSE": 0, "KEY_OFFER": 52, "KEY_ANSWER": 52}.get(name, 8)]
        (read,) = frame.decode_frames(memoryview(plain))
        assert type(read).__name__.upper() == name.replace("_", "")
    assert (frame.FRAGMENT_TYPE, frame.REPAIR_TYPE) == (of_page["FRAGMENT"], of_page["REPAIR"])
    unknown = set(range(256)) - set(of_page.values())
    for number in unknown:
        with pytest.raises(DecodeError):
            frame.decode_frames(memoryview(bytes([number]) + body))


def test_the_numbers_on_the_page_are_those_of_the_code() -> None:
    for said in (
        f"total ≤ {frame.MAX_MESSAGE_BYTES}, {frame.MIN_SYMBOL_BYTES} ≤ symbol ≤ {frame.MAX_SYMBOL_BYTES}",
        f"1 ≤ n ≤ {frame.MAX_ACK_RANGES}",
        f"up to {frame.MAX_FRAMES} frames",
        f"{frame.MIN_DATAGRAM_BYTES} bytes is the shortest datagram, {frame.MAX_DATAGRAM_BYTES} the longest",
        f"to be introduced {introduction.MAX_INTRODUCED_BYTES}",
        f"lower four the protocol's version, {PROTOCOL_VERSION}",
        f"{key_exchange.RENEW_AFTER_S:.0f} s old",
        f"2^{key_exchange.RENEW_AFTER_DATAGRAMS.bit_length() - 1} datagrams were sealed",
        f"seals 2^{key_exchange.MAX_SEALED.bit_length() - 1} datagrams",
        f"after 2^{MAX_FAILED.bit_length() - 1} the path",
        f"{key_exchange.EXCHANGES_AT_ONCE:.0f} exchanges at once and {key_exchange.EXCHANGES_PER_S:.0f} a second",
        f"most {address.AMPLIFICATION} times",
        f"drops it when {LATE_S:.0f} s have passed since the change",
        f"late, {key_exchange.WAITS_S:.0f} s at most",
        f"at most {LOOKS_PER_S:.0f} a second are judged",
        f"{ALL_LOOKS_AT_ONCE:.0f} at once, and {ALL_LOOKS_PER_S:.0f} a second",
        f"At most {introductions.MAX_INTRODUCTIONS} introductions over a path",
        f"may begin {path_table.NEW_PATHS} paths at once in this way, and {path_table.NEW_PATHS_PER_S:.0f} a second",
        f"already has {path_table.MAX_PATHS_OF_A_PEER} path",
        f"get {path_table.UNPROVEN_BYTES} bytes at once, and {path_table.UNPROVEN_BYTES_PER_S:.0f} bytes a second",
        f"up to {reassembly.MAX_PEER_BYTES >> 20} MiB of one peer's half messages",
        f"up to {reassembly.MAX_PEER_MESSAGES} of them",
        f"no symbol for {reassembly.MAX_SILENCE_S:.0f} s",
        f"under a new number, up to {outbox.MAX_GENERATIONS} times",
        f"last byte is divisible by {OBSERVED_ONE_IN}",
    ):
        assert said in " ".join(PAGE.split()), said
    assert RESTART_GAP_S == 1.0  # "one restart a second"


def test_the_counters_on_the_page_are_those_of_the_metrics() -> None:
    metrics = (DOCS.parent / "operate" / "metrics.md").read_text(encoding="utf-8")
    named = [name for row in table("## What is dropped, and its counter") for name in re.findall(r"`(\w+)`", row[1])]
    assert len(named) > 20
    assert [name for name in named if f"`{name}`" not in metrics] == []


def test_the_tests_that_the_page_names_exist() -> None:
    named = set(re.findall(r"`(tests/[a-z_/]+\.py)`", PAGE))
    assert len(named) > 10
    assert [name for name in sorted(named) if not (DOCS.parents[1] / name).exists()] == []
