"""A control plane that is late: what lies unread in its buffers costs nobody the lease."""

from __future__ import annotations

import contextlib
import signal
import threading
import time
from typing import TYPE_CHECKING

import pytest

from plr.protos.model.members import PeerSet
from plr.protos.trust.identity import IdentityRole
from tests.support.control_plane_process import PATIENCE_S, cloud, robot
from tests.support.secured_control_plane import SecuredControlPlane

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from tests.support.control_plane_process import Sidecar

LEASE_S = 2.0
EXPIRED = 'plr_departures_total{reason="lease_expired"}'
POSTPONED = "plr_leases_postponed_total"


@contextlib.contextmanager
def beating(sidecars: list[Sidecar]) -> Iterator[None]:
    """Within it they speak, each several times in a lease."""
    over = threading.Event()

    def beat() -> None:
        while not over.wait(LEASE_S / 5):
            for sidecar in sidecars:
                sidecar.beat()

    thread = threading.Thread(target=beat)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()


@pytest.mark.audit("ops-16")
def test_who_spoke_while_it_could_not_listen_keeps_the_lease_and_who_did_not_loses_it(tmp_path: Path) -> None:
    with SecuredControlPlane(tmp_path, lease_ms=round(1000 * LEASE_S)) as plane:
        names = [f"robot-{number}" for number in range(8)]
        with contextlib.ExitStack() as streams:
            server = streams.enter_context(cloud(plane.address, "cloud-a", plane.member("cloud-a", IdentityRole.CLOUD)))
            robots = [
                streams.enter_context(robot(plane.address, name, plane.member(name), incarnation=1)) for name in names
            ]
            silent = robot(plane.address, "silent", plane.member("silent"))
            with beating([server, *robots]):
                server.expect(PeerSet, lambda message: len(message.peers) == len(names) + 1)
                silent.beat()
                plane.send_signal(signal.SIGSTOP)
                time.sleep(2 * LEASE_S)
                plane.send_signal(signal.SIGCONT)
                patience = time.monotonic() + PATIENCE_S
                while plane.count(EXPIRED) == 0:
                    assert time.monotonic() < patience, "the silent one has gone"
                    time.sleep(0.05)
                time.sleep(LEASE_S)
                assert plane.count(EXPIRED) == 1
                assert plane.count(POSTPONED) >= 1
            silent.kill()
        plane.stop_flawless()
