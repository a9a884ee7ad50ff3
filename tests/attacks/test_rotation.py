"""Every key and certificate changes while requests go on, the CA's too: none is lost, and none is late because of it.

`--rotation-seconds 120` is the long version.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from lab.system import CONTROL_METRICS_PORT, METRICS_PORT, System
from plr.controlplane.ca import Authority
from plr.controlplane.ca.files import write_atomically, write_tls_files
from plr.protos.program.tls_files import CA_FILE, CRL_FILE
from tests.attacks.world import World, attack_lab, is_ours
from tests.support.calling import Call, assert_flawless

if TYPE_CHECKING:
    from collections.abc import Iterator

    from lab.attacker.wire import Captured
    from plr.controlplane.ca import Issued

pytestmark = [pytest.mark.netns, pytest.mark.ros, pytest.mark.timeout(600)]

REKEY_AFTER_S = 2
PHASE_BIT = 0b10
"""Of the flags, the second byte of a datagram."""
NODES = ("control", "robot", "cloud-a", "cloud-b")
"""Who has certificates."""
TAKEN_S = 10.0
"""Within this, a program on a busy machine has taken new files."""
EXPIRY = "plr_certificate_expiry_timestamp_seconds"


@pytest.fixture
def rotating(tmp_path_factory: pytest.TempPathFactory) -> Iterator[World]:
    """A system of its own, whose data-plane keys do not get old."""
    with attack_lab() as lab:
        world = World(System(lab, tmp_path_factory.mktemp("rotation")))
        try:
            world.start(rekey_after_s=REKEY_AFTER_S)
            yield world
        finally:
            world.close()


def test_everything_is_rotated(rotating: World, rotation_seconds: float) -> None:
    world = rotating
    taps = [world.tap("robot", "wlan0"), world.tap("robot", "wwan0")]
    call = Call(world.system, "--rate", "20", "--duration", f"{rotation_seconds:g}")
    call.wait_until_sending()
    old, new = world.system.authority, Authority.create("next")
    roles = {name: old.latest(name).role for name in NODES}
    both, lists = old.ca_pem + new.ca_pem, old.crl_pem() + new.crl_pem()
    # As in docs/start/certificates.md: all believe both CAs, then all get a certificate of the new one, then
    # nobody believes the old one.
    for name in NODES:
        install(world, name, old.renew(name, days=100), both, lists)
    for name in NODES:
        install(world, name, new.issue(name, roles[name], days=200), both, lists)
    for name in NODES:
        install(world, name, None, new.ca_pem, new.crl_pem())
    run = call.result(rotation_seconds + 60.0)
    assert_flawless(run)
    # A machine that stands still for half a second makes ten late; who waited for a certificate or a stream would make
    # as many in each of the three steps, or lose them.
    assert run["summary"]["deadline_missed"] <= run["summary"]["sent"] / 20, run["summary"]
    changes = phase_changes([one for tap in taps for one in tap.take() if is_ours(one)])
    assert len(changes) >= 4, "each path in use, both ways"
    assert min(changes.values()) >= rotation_seconds / REKEY_AFTER_S / 3
    for part in world.system.parts.values():
        assert " ERROR " not in part.log.read_text(), part.tail()


def install(world: World, name: str, issued: Issued | None, ca_pem: bytes, crl_pem: bytes) -> None:
    """Put new files in place; returns when the program has taken the certificate."""
    folder = world.tls_dir(name)
    if issued is None:
        write_atomically(folder / CA_FILE, ca_pem, 0o644)
        write_atomically(folder / CRL_FILE, crl_pem, 0o644)
        return
    write_tls_files(folder, issued, ca_pem, crl_pem)
    ends = issued.certificate.not_valid_after_utc.timestamp()
    world.system.wait(f"{name} to take its certificate", lambda: expiry(world, name) == ends, TAKEN_S)


def expiry(world: World, name: str) -> float:
    """When the certificate ends that a program says it uses."""
    port = CONTROL_METRICS_PORT if name == "control" else METRICS_PORT
    return world.system.metrics(name.replace("-", "_"), port).get(EXPIRY, 0.0)


def phase_changes(seen: list[Captured]) -> dict[bytes, int]:
    """How often each path and direction in use changed its key, by the clear bit that tells which one it is."""
    found: dict[bytes, int] = {}
    last: dict[bytes, int] = {}
    for one in seen:
        # Interfaces and session of the sender; introductions belong to no phase.
        path = one.payload[2:12]
        if one.payload[1] & ~PHASE_BIT == 1:
            phase = one.payload[1] & PHASE_BIT
            found[path] = found.get(path, 0) + (last.get(path, phase) != phase)
            last[path] = phase
    return {path: count for path, count in found.items() if count}
