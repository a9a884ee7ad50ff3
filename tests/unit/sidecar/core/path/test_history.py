from __future__ import annotations

from collections import Counter

import pytest

from plr.protos.model.ids import InterfaceId
from plr.sidecar.core.base.values import PathId, PathState
from plr.sidecar.core.path.history import MAX_CHANGED_PATHS, LivenessChange, PathHistory
from plr.sidecar.core.seam.links import PathChanged
from tests.support.builders import WLAN, A

pytestmark = pytest.mark.audit("ops-14")

PATH = PathId(WLAN, A, InterfaceId(0))


def test_it_tells_since_when_and_why_and_not_how_often_it_was_told() -> None:
    history = PathHistory(Counter())
    assert history.last(PATH) is None
    history.note(PathChanged(PATH, PathState.UP, "answers"), 1.0)
    history.note(PathChanged(PATH, PathState.DOWN, "silent"), 5.0)
    history.note(PathChanged(PATH, PathState.DOWN, "not usable here"), 9.0)
    assert history.last(PATH) == LivenessChange(PathState.DOWN, 5.0, "silent")


def test_it_forgets_what_changed_longest_ago_and_counts_that() -> None:
    drops: Counter[str] = Counter()
    history = PathHistory(drops)
    for number in range(MAX_CHANGED_PATHS + 1):
        history.note(PathChanged(PATH._replace(peer=f"cloud-{number}"), PathState.UP, "answers"), 1.0)  # type: ignore[arg-type]
    assert len(history.all()) == MAX_CHANGED_PATHS
    assert drops == {"path_history_full": 1}
