"""Fixtures of the ROS tests: domains, and a robot bridge joined with a cloud bridge."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from tests.ros.mesh import Mesh
from tests.support.ros_domains import leased_domain

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path


@pytest.fixture
def robot_domain() -> Iterator[int]:
    """A second domain, beside `ros_domain`."""
    with leased_domain() as domain:
        yield domain


@pytest.fixture
def mesh(robot_domain: int, ros_domain: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Mesh]:
    """A mesh that is not started yet; applications join it with `serve` and `call`."""
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    monkeypatch.setenv("ROS_LOG_DIR", str(tmp_path / "ros-logs"))
    with Mesh(robot_domain, ros_domain, tmp_path) as made:
        yield made
