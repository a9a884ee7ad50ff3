"""Two servers swap load: the mapping follows, says why, and no request is lost meanwhile.

How fast it follows is measured by `python -m bench matcher --only live`, on a machine that has time for it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from bench.matcher.live import swap_load

if TYPE_CHECKING:
    from pathlib import Path

pytestmark = [pytest.mark.netns, pytest.mark.ros, pytest.mark.timeout(240)]


def test_the_mapping_follows_the_load_and_nothing_is_lost(tmp_path: Path) -> None:
    followed = swap_load(tmp_path, interfaces=1, before_s=5.0)
    assert followed.lost == 0
    assert followed.sent > 0
    assert "moved because all copies would have missed with probability" in followed.reason
