"""What several files here begin with."""

from __future__ import annotations

import pytest

from tests.support.control_world import World


@pytest.fixture
def world() -> World:
    return World()
