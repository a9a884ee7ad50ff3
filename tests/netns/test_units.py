"""The restrictions of the units let both programs do their work."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

from tests.netns.unit_sandbox import allowed_calls
from tests.netns.unit_world import FIRST_DAYS, WORKING, days_left

if TYPE_CHECKING:
    from collections.abc import Iterator

pytestmark = [pytest.mark.netns, pytest.mark.ros]

DEPLOY = Path(__file__).parents[2] / "deploy"
WORLD = Path(__file__).with_name("unit_world.py")


@pytest.fixture(scope="module")
def seen() -> Iterator[dict[str, Any]]:
    """What the outside saw of a start, some seconds of work and a stop of both."""
    if os.geteuid() != 0:
        pytest.skip("becoming the units' users takes root")
    # Not pytest's own folder, which other users may not enter.
    folder = tempfile.mkdtemp(prefix="plr-units-")
    Path(folder).chmod(0o755)
    try:
        world = subprocess.run(
            ["unshare", "--net", sys.executable, WORLD, folder], capture_output=True, text=True, timeout=110
        )
        assert world.returncode == 0, world.stderr
        yield json.loads(world.stdout.splitlines()[-1])
    finally:
        shutil.rmtree(folder)


@pytest.mark.parametrize("program", ["controlplane", "sidecar"])
def test_the_program_starts_stops_and_tells_systemd(seen: dict[str, Any], program: str) -> None:
    told = seen[program]
    assert told["ready"], told["log"]
    assert told["stopping"], told["log"]
    assert told["exit"] == 0, told["log"]


@pytest.mark.parametrize("program", ["controlplane", "sidecar"])
def test_nothing_it_does_is_refused(seen: dict[str, Any], program: str) -> None:
    log = seen[program]["log"]
    for complaint in ("Operation not permitted", "Permission denied", "Read-only file system", "Traceback"):
        assert complaint not in log


def test_the_sidecar_reaches_the_control_plane_and_its_stun_server(seen: dict[str, Any]) -> None:
    measured = seen["controlplane"]["metrics"] | seen["sidecar"]["metrics"]
    assert [name for name in WORKING if not measured.get(name)] == [], seen["sidecar"]["log"]


@pytest.mark.parametrize("program", ["controlplane", "sidecar"])
def test_a_renewed_certificate_is_taken_up_without_a_restart(seen: dict[str, Any], program: str) -> None:
    assert days_left(seen[program]["metrics"]) > FIRST_DAYS, seen[program]["log"]


def test_the_sidecar_may_bind_its_sockets_to_the_interface(seen: dict[str, Any]) -> None:
    assert "bound to the device" in seen["sidecar"]["log"]


@pytest.mark.parametrize("unit", ["plr-sidecar", "plr-controlplane"])
def test_the_filter_is_one(unit: str) -> None:
    allowed = allowed_calls((DEPLOY / "systemd" / f"{unit}.service").read_text())
    assert {"recvmsg", "sendmsg", "epoll_wait", "execve"} <= allowed
    assert not {"mount", "ptrace", "reboot", "bpf", "setuid", "chown", "init_module"} & allowed
