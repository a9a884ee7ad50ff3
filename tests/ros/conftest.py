"""Fixtures of the ROS tests: domains, and a robot bridge joined with a cloud bridge."""

from __future__ import annotations

import fcntl
import os
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from tests.ros.mesh import Mesh

if TYPE_CHECKING:
    from collections.abc import Iterator

ROS_DOMAINS = range(99, 0, -1)


@pytest.fixture
def robot_domain() -> Iterator[int]:
    """A second domain, beside `ros_domain`, that nobody else on this machine has at the moment."""
    locks = Path(tempfile.gettempdir()) / f"plr-test-domains-{os.getuid()}"
    locks.mkdir(exist_ok=True)
    for domain in ROS_DOMAINS:
        with (locks / str(domain)).open("w") as lock:
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                continue
            yield domain
            return
    pytest.fail("every ROS domain is taken")


@pytest.fixture
def mesh(robot_domain: int, ros_domain: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Mesh]:
    """A mesh that is not started yet; applications join it with `serve` and `call`."""
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    monkeypatch.setenv("ROS_LOG_DIR", str(tmp_path / "ros-logs"))
    with Mesh(robot_domain, ros_domain, tmp_path) as made:
        yield made
