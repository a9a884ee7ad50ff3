"""Whose certificates have ended, without a look at all of them."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from plr.controlplane.serve.earliest_end import EarliestEnd
from plr.protos.model.ids import NodeName

if TYPE_CHECKING:
    from collections.abc import Iterator

pytestmark = pytest.mark.audit("ops-19")


def test_all_are_looked_at_only_when_one_may_have_ended() -> None:
    in_use = {NodeName("a"): 10.0, NodeName("b"): 20.0, NodeName("c"): 30.0}
    looks = 0

    def look() -> Iterator[tuple[NodeName, float]]:
        nonlocal looks
        looks += 1
        yield from in_use.items()

    ends = EarliestEnd()
    for end in in_use.values():
        ends.note(end)
    assert ends.ended(look(), 10.0) == []
    assert looks == 0
    assert ends.ended(look(), 10.5) == ["a"]
    assert looks == 1
    del in_use[NodeName("a")]
    assert ends.ended(look(), 20.0) == []
    assert looks == 1
    # The first one has gone: one look for nothing, and then none.
    del in_use[NodeName("b")]
    assert ends.ended(look(), 25.0) == []
    assert ends.ended(look(), 26.0) == []
    assert looks == 2
    in_use[NodeName("d")] = 27.0
    ends.note(27.0)
    assert ends.ended(look(), 31.0) == ["c", "d"]
    assert ends.ended(look(), 99.0) == [], "nobody is told twice by himself"
    assert looks == 3
