"""Another certificate or revocation list: everybody is judged again, in turns of the loop."""

from __future__ import annotations

import asyncio
import contextlib
import time
from typing import TYPE_CHECKING

import pytest

from plr.controlplane import turns
from plr.controlplane.config.controlplane import ControlPlaneConfig
from plr.controlplane.loop import ControlLoop
from plr.controlplane.observe import metrics as metrics_module
from plr.controlplane.observe.event_log import EventLog
from plr.controlplane.observe.metrics import Metrics
from plr.controlplane.serve import certificate_watch
from plr.controlplane.serve.certificate_watch import CertificateKeeper
from plr.protos.program.tls_files import load_tls_files
from plr.protos.trust.clock_floor import ClockFloor
from tests.integration.test_tls_gate import PATIENCE_S, opened, until

if TYPE_CHECKING:
    from collections.abc import AsyncIterator
    from pathlib import Path

    from plr.protos.model.ids import NodeName
    from tests.integration.test_tls_gate import Gate

pytestmark = pytest.mark.audit("ops-19")

MEMBERS = [f"robot-{number}" for number in range(8)]


@contextlib.asynccontextmanager
async def watched(gate: Gate, metrics: Metrics | None = None) -> AsyncIterator[list[NodeName]]:
    """A keeper at work; whom it has judged so far, in order."""
    judged: list[NodeName] = []
    review = gate.gate.review

    def noting(name: NodeName) -> None:
        judged.append(name)
        review(name)

    gate.gate.review = noting  # type: ignore[method-assign]  # a spy
    metrics = metrics or Metrics()
    loop = ControlLoop(ControlPlaneConfig(insecure=True, listen="127.0.0.1:0"), metrics, EventLog(None))
    files = load_tls_files(gate.fleet.tls_dir("control"))
    keeper = CertificateKeeper(files, gate.gate, loop, metrics, ClockFloor(time.time))
    running = asyncio.create_task(keeper.run())
    try:
        yield judged
    finally:
        running.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await running


def revoke(gate: Gate, name: str) -> None:
    gate.fleet.authority.revoke(name)
    control = gate.fleet.tls_dir("control")
    part = control / "part"
    part.write_bytes(gate.fleet.authority.crl_pem())
    part.replace(control / "crl.pem")


@pytest.fixture(autouse=True)
def short_turns(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(turns, "TURN_S", 0.0)
    monkeypatch.setattr(certificate_watch, "POLL_INTERVAL_S", 0.02)


@contextlib.asynccontextmanager
async def all_connected(gate: Gate) -> AsyncIterator[None]:
    streams = [await gate.connect(name) for name in MEMBERS]
    try:
        await until(lambda: len(gate.peers) == len(MEMBERS))
        yield
    finally:
        for _, writer in streams:
            writer.close()


def test_who_is_revoked_is_judged_first_and_everybody_is(tmp_path: Path) -> None:
    async def run() -> None:
        async with opened(tmp_path) as gate, all_connected(gate), watched(gate) as judged:
            revoke(gate, MEMBERS[5])
            await until(lambda: len(judged) == len(MEMBERS))
            assert judged[0] == MEMBERS[5]
            assert set(judged) == set(MEMBERS)
            assert gate.refused == {"revoked": 1}
            await asyncio.sleep(0.1)
            assert len(judged) == len(MEMBERS), "and once"

    asyncio.run(run())


def test_a_change_amid_the_turns_of_another_loses_nothing(tmp_path: Path) -> None:
    async def run() -> None:
        async with opened(tmp_path) as gate, all_connected(gate), watched(gate) as judged:
            revoke(gate, MEMBERS[0])
            async with asyncio.timeout(PATIENCE_S):
                while len(judged) < 3:  # noqa: ASYNC110 - what is waited for has no event
                    await asyncio.sleep(0)
            already = str(judged[1])
            revoke(gate, already)
            await until(lambda: [str(name) for name in judged].count(already) == 2)
            await until(lambda: all(name in judged for name in MEMBERS))
            await until(lambda: gate.refused == {"revoked": 2})

    asyncio.run(run())


@pytest.mark.audit("ops-12")
def test_files_that_are_not_taken_are_reported_until_they_are_corrected(tmp_path: Path) -> None:
    """The control plane goes on with those of before: only its next start would show it."""
    metrics = Metrics()

    def mend(folder: Path, content: dict[str, bytes]) -> None:
        for name, data in content.items():
            (folder / name).write_bytes(data)

    async def run() -> None:
        async with opened(tmp_path) as gate, watched(gate, metrics):
            folder = gate.fleet.tls_dir("control")
            good = {path.name: path.read_bytes() for path in folder.iterdir()}
            robot = {path.name: path.read_bytes() for path in gate.fleet.tls_dir("robot-1").iterdir()}
            # Broken; then whole, but not a control plane's.
            for bad in ({"ca.pem": b""}, robot):
                assert refused() == 0.0
                mend(folder, bad)
                await until(lambda: refused() == 1.0)
                mend(folder, good)
                await until(lambda: refused() == 0.0)

    def refused() -> float | None:
        families = metrics_module._certificate(metrics._own, metrics.files_refused)
        return {family.name: family.samples[0].value for family in families}["plr_tls_files_refused"]

    asyncio.run(run())
