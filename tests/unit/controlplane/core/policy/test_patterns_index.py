"""The index finds what trying every list of patterns finds."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from plr.controlplane.core.policy.patterns import PatternIndex, matches

_NAMES = st.text("ab1]", min_size=1, max_size=4)
_PATTERNS = st.text("ab1*?[!]", min_size=1, max_size=5)
_LISTS = st.lists(st.lists(_PATTERNS | _NAMES, min_size=1, max_size=3).map(tuple), max_size=8)


@given(_LISTS, _NAMES)
def test_it_finds_the_lists_that_match_and_no_others(lists: list[tuple[str, ...]], name: str) -> None:
    expected = {number for number, patterns in enumerate(lists) if matches(name, patterns)}
    assert PatternIndex(lists).matching(name) == expected


def test_a_name_is_tried_against_no_patterns_that_begin_otherwise() -> None:
    index = PatternIndex([(f"robot-{number}", f"arm-{number}*") for number in range(1000)])
    assert index.matching("robot-77") == {77}
    assert index.matching("arm-123") == {1, 12, 123}
    assert index.matching("cloud") == set()
