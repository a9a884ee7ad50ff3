"""What every kind of test may need."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest
from hypothesis import HealthCheck, settings

from tests.support.ros_domains import leased_domain

if TYPE_CHECKING:
    from collections.abc import Iterator

# How long an example takes depends on what else the machine does.
settings.register_profile("plr", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("plr")


@pytest.fixture
def ros_domain() -> Iterator[int]:
    """A ROS domain that no other test on this machine has at the moment."""
    with leased_domain() as domain:
        yield domain


def pytest_addoption(parser: pytest.Parser) -> None:
    """Options of our own."""
    parser.addoption(
        "--fuzz-datagrams", type=int, default=20_000, help="datagrams that each fuzzing test sends (default 20000)"
    )
    parser.addoption(
        "--rotation-seconds", type=float, default=15.0, help="length of the run that rotates all keys (default 15)"
    )


@pytest.fixture(scope="session")
def rotation_seconds(pytestconfig: pytest.Config) -> float:
    """How long the run shall take in which every key is changed."""
    seconds: float = pytestconfig.getoption("--rotation-seconds")
    return seconds


@pytest.fixture(scope="session")
def fuzz_datagrams(pytestconfig: pytest.Config) -> int:
    """How many datagrams a fuzzing test shall send."""
    count: int = pytestconfig.getoption("--fuzz-datagrams")
    return count
