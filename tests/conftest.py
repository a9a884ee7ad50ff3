"""What every kind of test may need."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from tests.ros_domains import leased_domain

if TYPE_CHECKING:
    from collections.abc import Iterator


@pytest.fixture
def ros_domain() -> Iterator[int]:
    """A ROS domain that no other test on this machine has at the moment."""
    with leased_domain() as domain:
        yield domain
