"""What an operator reads of a path."""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING

from plr.protos.model.ids import InterfaceId, InterfaceName, NodeName
from plr.sidecar.core.base.values import PathId, PathState
from plr.sidecar.core.seam.links import PathChanged
from plr.sidecar.net.path_log import PathLog

if TYPE_CHECKING:
    import pytest

PATH = PathId(InterfaceName("wwan0"), NodeName("cloud-a"), InterfaceId(0))


def test_ups_and_downs_are_said_once_and_wobbles_only_to_debug(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    log = PathLog()
    states = (PathState.UP, PathState.UNSTABLE, PathState.UP, PathState.DOWN, PathState.DOWN, PathState.UP)
    for state in states:
        log.note(PathChanged(PATH, state, "silent" if state is PathState.DOWN else "answers"))
    assert [record.getMessage() for record in caplog.records] == [
        "path wwan0 to cloud-a is up: answers",
        "path wwan0 to cloud-a is down: silent",
        "path wwan0 to cloud-a is up: answers",
    ]
