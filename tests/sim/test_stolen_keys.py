"""What one stolen session key, or all the memory of a running sidecar, is good for: never for the past, nor for others.

Sans-IO cores in simulated time; the thief runs the whole stack, with one private key in place of the right one.
"""

from __future__ import annotations

import gc
from dataclasses import replace
from types import FunctionType, ModuleType
from typing import TYPE_CHECKING

import pytest
from cryptography.exceptions import InvalidTag
from cryptography.hazmat.primitives.asymmetric.x25519 import X25519PrivateKey, X25519PublicKey

from lab.simulated.mesh import Mesh, Node
from lab.simulated.sessions import private_key
from plr.sidecar.core.base.values import PathState
from plr.sidecar.core.crypto.aead import KEY_BYTES, TAG_BYTES, make_cipher
from plr.sidecar.core.path.key_exchange import KeyLimits
from plr.sidecar.core.wire.frame import CLEAR, HEADER_BYTES, INTRODUCTION_FLAG, NONCE_OFFSET, decode_header
from tests.sim.test_mesh import assert_each_answered_once
from tests.sim.test_sealing import dropped, phases

if TYPE_CHECKING:
    from collections.abc import Iterator

    from plr.protos.model.ids import Address
    from plr.protos.model.members import Peer
    from plr.protos.trust.credential import Aead
    from plr.sidecar.core.crypto.key_schedule import PairKeys

pytestmark = pytest.mark.audit("sec-9")


def play(thief: Node, victim: Node, monkeypatch: pytest.MonkeyPatch) -> None:
    """Give the thief what follows from the victim's private key and what is public, but not its own session's key."""

    def admit(peer: Peer) -> PairKeys:
        stolen = victim.own.admit(thief.told_to(victim))
        public = X25519PrivateKey.from_private_bytes(private_key(peer.name, peer.session)).public_key()
        own = X25519PrivateKey.from_private_bytes(bytes(31) + b"\7")
        return replace(
            stolen, first=not stolen.first, own=own, theirs=X25519PublicKey.from_public_bytes(public.public_bytes_raw())
        )

    monkeypatch.setattr(thief.own, "admit", admit)


@pytest.mark.parametrize("victim", ["robot", "cloud-a"])
def test_who_stole_a_session_key_can_not_play_another_to_its_owner(
    victim: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    mesh = Mesh(1)
    robot, cloud = mesh.robot("wlan0"), mesh.cloud("cloud-a")
    thief = cloud if victim == "robot" else robot
    play(thief, mesh.nodes[victim], monkeypatch)
    mesh.push_views()
    mesh.run(1.0)
    robot.submit(b"for the right one alone")
    mesh.run(20.0)
    assert not robot.responses()
    assert not cloud.executed
    for node in (robot, cloud):
        assert all(path.state is PathState.DOWN for link in node.links.values() for path in link._paths.values())
        assert dropped(node)["unauthentic"] == 0, "it came as far as the exchange of keys"
    assert dropped(robot)["bad_keys"] > 0
    assert not dropped(mesh.nodes[victim])["before_fresh_keys"], "nothing but probes was sent to it"


def test_the_thief_of_these_tests_fails_for_want_of_the_key_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    mesh = Mesh(1)
    robot, cloud = mesh.robot("wlan0"), mesh.cloud("cloud-a")
    play(cloud, robot, monkeypatch)
    right = X25519PrivateKey.from_private_bytes(private_key(cloud.name, cloud.session))
    faulty = cloud.own.admit
    monkeypatch.setattr(cloud.own, "admit", lambda peer: replace(faulty(peer), own=right))
    mesh.push_views()
    mesh.run(1.0)
    robot.submit(b"x")
    mesh.run(1.0)
    assert_each_answered_once(robot, 1)


# -- memory that is read ----------------------------------------------------------------------------------------------


def secrets_in(*nodes: Node) -> set[bytes]:
    """Every 32 bytes in a row that hang on the cores, as objects of their own; private keys as their bytes."""
    seen: set[int] = set()
    found: set[bytes] = set()
    queue: list[object] = [one for node in nodes for one in (node.engine, node.own, *node.links.values())]
    while queue:
        item = queue.pop()
        if id(item) in seen or isinstance(item, (type, ModuleType, FunctionType, Mesh)):
            continue
        seen.add(id(item))
        if isinstance(item, bytes) and len(item) == KEY_BYTES:
            found.add(item)
        elif isinstance(item, X25519PrivateKey):
            found.add(item.private_bytes_raw())
        queue.extend(gc.get_referents(item))
    return found


def keys_from(secrets: set[bytes], pair: PairKeys) -> Iterator[bytes]:
    """Every key that follows from one of them at once, whatever it is: a key, or a root."""
    for secret in secrets:
        yield secret
        yield pair.sealing_key(secret)
        yield pair.opening_key(secret)


def opens(datagram: bytes, keys: list[bytes], aead: Aead) -> bool:
    clear, sealed = datagram[:HEADER_BYTES], datagram[HEADER_BYTES:]
    out = bytearray(len(sealed) - TAG_BYTES)
    for key in keys:
        try:
            make_cipher(aead, key).decrypt_into(clear[NONCE_OFFSET:], sealed, clear, out)
        except InvalidTag:
            continue
        return True
    return False


def test_all_the_memory_of_both_ends_opens_nothing_of_two_phases_ago() -> None:
    mesh = Mesh(1)
    mesh.key_limits = KeyLimits(seconds=2.0)
    robot, cloud = mesh.robot("wlan0"), mesh.cloud("cloud-a")
    sent: dict[int, list[bytes]] = {}

    def tap(_source: Address, _destination: Address, data: bytes) -> None:
        if not decode_header(data).flags & INTRODUCTION_FLAG:
            sent.setdefault(min(phases(robot)), []).append(data)

    mesh.push_views()
    mesh.run(1.0)
    mesh.tap = tap
    for _ in range(120):
        robot.submit(bytes(200))
        mesh.run(0.25)
    mesh.tap = None
    assert_each_answered_once(robot, 120)
    last = max(sent)
    assert last > 8
    pair = robot.own.admit(cloud.told_to(robot))
    keys = list(keys_from(secrets_in(robot, cloud), pair))
    assert opens(sent[last][-1], keys, pair.aead), "it is the keys of today that are found"
    old = [datagram for phase in range(1, last - 1) for datagram in sent[phase][::10]]
    assert len(old) > 20
    assert not any(opens(datagram, keys, pair.aead) for datagram in old)
    assert CLEAR.size == HEADER_BYTES
