"""No nonce is used twice under a key, whatever happens to links, views, sidecars and the network, in random worlds."""

from __future__ import annotations

import random
from typing import TYPE_CHECKING, Any

import pytest
from cryptography.hazmat.primitives.ciphers.aead import AESGCM, ChaCha20Poly1305

from lab.simulated.mesh import Mesh, Node
from plr.protos.model.ids import Version
from plr.protos.model.members import PeerSet
from plr.protos.trust.credential import Aead
from plr.sidecar.core.crypto import aead
from plr.sidecar.core.link.link import Link
from plr.sidecar.core.path.key_exchange import KeyLimits
from plr.sidecar.core.seam.links import ResetPaths, SetPeers, SetReady
from plr.sidecar.core.wire import introduction

if TYPE_CHECKING:
    from plr.protos.model.ids import InterfaceName

WORLDS = 24
LEAST_SEALS = 200
"""Of each world: less would prove nothing."""


class Recorder:
    """Ciphers that note what they seal."""

    def __init__(self) -> None:
        self.sealed: dict[tuple[bytes, bytes], bytes] = {}
        self.reused: list[tuple[bytes, bytes]] = []

    def note(self, key: bytes, nonce: Any, content: bytes) -> None:
        known = self.sealed.setdefault((key, bytes(nonce)), content)
        if known != content:
            self.reused.append((key, bytes(nonce)))

    def cipher(self, kind: Aead, key: bytes) -> Any:
        return Noted(self, (AESGCM if kind is Aead.AES_256_GCM else ChaCha20Poly1305)(key), bytes(key))

    def chacha(self, key: bytes) -> Any:
        return self.cipher(Aead.CHACHA20_POLY1305, key)


class Noted:
    def __init__(self, recorder: Recorder, cipher: Any, key: bytes) -> None:
        self._recorder, self._cipher, self._key = recorder, cipher, key

    def encrypt(self, nonce: Any, data: Any, more: Any) -> Any:
        self._recorder.note(self._key, nonce, bytes(data) + bytes(more))
        return self._cipher.encrypt(nonce, data, more)

    def encrypt_into(self, nonce: Any, data: Any, more: Any, buffer: Any) -> Any:
        self._recorder.note(self._key, nonce, bytes(data) + bytes(more))
        return self._cipher.encrypt_into(nonce, data, more, buffer)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._cipher, name)


class World:
    """A robot with two interfaces, a cloud, and what befalls them."""

    def __init__(self, seed: int) -> None:
        self.rng = rng = random.Random(seed)
        self.mesh = mesh = Mesh(seed)
        datagrams = rng.choice([5, 50, 1 << 21])
        mesh.key_limits = KeyLimits(datagrams=datagrams, seconds=rng.choice([0.3, 2.0, 120.0]), sealed=4 * datagrams)
        self.cloud, self.robot = mesh.cloud("cloud"), mesh.robot("wlan0", "lte0")
        for interface in self.robot.interfaces:
            for wire in mesh.both_ways(f"robot.{interface}", "cloud.eth0"):
                wire.loss, wire.duplicate = rng.choice([0.0, 0.1, 0.5]), rng.choice([0.0, 0.3])
                wire.jitter_s = rng.choice([0.0, 0.05, 0.5])
        mesh.push_views()

    def step(self) -> None:
        rng, mesh = self.rng, self.mesh
        node = rng.choice([self.cloud, self.robot])
        interface = rng.choice(node.interfaces)
        match rng.choice(["calls", "calls", "calls", "cut", "reset", "view", "relink", "hung", "restart"]):
            case "calls":
                for _ in range(rng.randrange(1, 5)):
                    self.robot.submit(bytes(rng.choice([3, 3000, 60_000])))
            case "cut":
                wire = rng.choice(mesh.both_ways(f"robot.{rng.choice(self.robot.interfaces)}", "cloud.eth0"))
                wire.cut = not wire.cut
            case "reset":
                node.links[interface].execute(ResetPaths("test"), node.now)
                mesh.pump(node)
            case "view":
                mesh.version += 1
                node.engine.apply_peers(PeerSet(Version(mesh.version), mesh.version, ()), node.now)
                mesh.pump(node)
                mesh.run(rng.random())
                mesh.push_views()
            case "relink":
                self.replace_link(node, interface, hangs=False)
            case "hung":
                self.replace_link(node, interface, hangs=True)
            case _:
                node.alive = False
                mesh.run(rng.random())
                node.start()
                mesh.push_views()
        mesh.run(rng.choice([0.01, 0.3, 3.0, 40.0]))

    def replace_link(self, node: Node, interface: InterfaceName, *, hangs: bool) -> None:
        """As after an interface went and came; one that hangs may seal a little more, which may have left."""
        old = node.links[interface]
        new = Link(old.identity, random.Random(self.rng.random()), node.now, old.remember(hangs=hangs))
        new.execute(SetReady(ready=True), node.now)
        node.links[interface] = new
        others = {name: link for name, link in node.links.items() if name != interface}
        node.engine.set_interfaces(others, node.now)
        self.mesh.pump(node)
        node.engine.set_interfaces(node.links, node.now)
        new.execute(SetPeers(node.engine.peers.for_links()), node.now)
        if hangs:
            for _ in range(5):
                old.batches_to_send(node.now + self.rng.random())
        self.mesh.pump(node)


@pytest.mark.audit("sec-9")
@pytest.mark.parametrize("seed", range(WORLDS))
def test_no_nonce_is_used_twice(seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    recorder = Recorder()
    monkeypatch.setattr(aead, "make_cipher", recorder.cipher)
    monkeypatch.setattr(introduction, "ChaCha20Poly1305", recorder.chacha)
    world = World(seed)
    for _ in range(15):
        world.step()
    assert not recorder.reused
    assert len(recorder.sealed) > LEAST_SEALS
