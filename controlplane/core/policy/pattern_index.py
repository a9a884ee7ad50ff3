"""Finds the lists of patterns that match a name without trying all of them.

A pattern can only match names that begin with what stands before its first special character. A fleet with a rule for
each robot therefore costs a look-up of each beginning of a name, not a match against each rule.
"""

from __future__ import annotations

import re
from collections import defaultdict
from typing import TYPE_CHECKING

from controlplane.core.policy.patterns import matches

if TYPE_CHECKING:
    from collections.abc import Iterable

_PLAIN_BEGINNING = re.compile(r"[^*?\[]*")


class PatternIndex:
    """Lists of patterns by number, from 0 on."""

    def __init__(self, lists: Iterable[tuple[str, ...]]) -> None:
        self._plain: defaultdict[str, set[int]] = defaultdict(set)
        """Patterns without special characters."""
        self._by_beginning: defaultdict[str, list[tuple[str, int]]] = defaultdict(list)
        for number, patterns in enumerate(lists):
            for pattern in patterns:
                beginning = _PLAIN_BEGINNING.match(pattern)
                assert beginning is not None
                if beginning[0] == pattern:
                    self._plain[pattern].add(number)
                else:
                    self._by_beginning[beginning[0]].append((pattern, number))

    def matching(self, name: str) -> frozenset[int]:
        """The numbers of the lists of which a pattern matches the name."""
        found = set(self._plain.get(name, ()))
        for length in range(len(name) + 1):
            for pattern, number in self._by_beginning.get(name[:length], ()):
                if number not in found and matches(name, (pattern,)):
                    found.add(number)
        return frozenset(found)
