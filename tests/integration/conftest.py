"""Control planes that run for a file's tests, or for one."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from tests.support.control_plane_process import ControlPlaneProcess

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path


@pytest.fixture(scope="module")
def plane(tmp_path_factory: pytest.TempPathFactory) -> Iterator[ControlPlaneProcess]:
    """One process for all tests of a file that do not end it; each test's sidecars say goodbye to it."""
    with ControlPlaneProcess(tmp_path_factory.mktemp("plane")) as process:
        yield process
        process.stop_flawless()


@pytest.fixture
def alone(tmp_path: Path) -> Iterator[ControlPlaneProcess]:
    """A process of the test's own, with short leases."""
    with ControlPlaneProcess(tmp_path, lease_ms=2000) as process:
        yield process
