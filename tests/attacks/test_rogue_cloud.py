"""A cloud of the fleet that was taken over: what it answers costs the robots nothing while an honest one is there."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from lab.attacker.rogue_cloud import SHARE
from lab.system import System
from tests.attacks.world import World, attack_lab
from tests.support.calling import Call

if TYPE_CHECKING:
    from collections.abc import Iterator

pytestmark = [pytest.mark.netns, pytest.mark.ros, pytest.mark.timeout(300)]

ROGUE = "cloud_a"
CALLS = ("--rate", "20", "--duration", "8")
MAX_RUNS = 5


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Iterator[World]:
    with attack_lab() as lab:
        stage = World(System(lab, tmp_path_factory.mktemp("rogue")))
        try:
            stage.start(rogue=ROGUE)
            yield stage
        finally:
            stage.close()


@pytest.mark.audit("sec-2")
def test_bad_answers_lose_no_request(world: World) -> None:
    (world.system.folder / f"{ROGUE}.sidecar{SHARE}").write_text("1")
    counted = 0.0
    # On a busy machine the honest one may be the faster for all of a run.
    for _ in range(MAX_RUNS):
        summary = Call(world.system, *CALLS).result()["summary"]
        assert summary["answered_once"] == summary["sent"] > 0, summary
        assert summary["invalid"] == summary["answered_twice"] == 0
        counted = world.counter("robot", "plr_bad_answers_total", peer="cloud-a")
        if counted:
            break
    # From the first one on others are asked for 10 s and more; those on their way then may still come.
    assert 0 < counted < 20 * 8 / 4
    log = world.system.parts["robot.sidecar"].log.read_text()
    assert "response from cloud-a dropped, other servers are asked" in log
    assert world.counter("robot", "plr_bad_answers_total", peer="cloud-b") == 0
