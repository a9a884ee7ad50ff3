"""One running system for each file of attacks."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from lab.system import System
from tests.attacks.world import World, attack_lab

if TYPE_CHECKING:
    from collections.abc import Iterator


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Iterator[World]:
    """The stage, with everything started; at the end, no request may have been lost."""
    with attack_lab() as lab:
        stage = World(System(lab, tmp_path_factory.mktemp("attacks")))
        try:
            stage.start()
            yield stage
            stage.end_calls()
        finally:
            stage.close()
