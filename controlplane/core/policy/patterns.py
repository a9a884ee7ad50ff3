"""Matches names with shell-style patterns, one by one or many at once.

`*` is any text ('/' included), `?` one character, `[ab]` or `[!ab]` one of or none of. Case counts. The dialect is
Python's `fnmatch.fnmatchcase`, as in the sidecars' `services[].name`.

A pattern can only match names that begin with its text before the first special character. `PatternIndex` uses this: a
fleet with a rule for each robot costs one look-up of each beginning of a name, not a match against each rule.
"""

from __future__ import annotations

import enum
import fnmatch
import functools
import re
import string
from collections import defaultdict
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterable

MAX_PATTERN_CHARACTERS = 255
"""No name is longer (protos/model/names.py)."""

_LETTERS = frozenset(string.ascii_letters)
_GRAPHIC = frozenset(map(chr, range(ord("!"), ord("~") + 1))) - {"/"}
_ALNUM = _LETTERS | frozenset(string.digits)


class NameKind(enum.Enum):
    """What a pattern stands for."""

    NODE = "a sidecar"
    SERVICE = "a service"
    INTERFACE = "an interface"


_State = tuple[tuple[frozenset[str], int], ...]
_STATES: dict[NameKind, tuple[tuple[_State, ...], int]] = {
    # Names that `plr.protos.model.names` accepts, as automata: where each state leads by which characters. The last
    # accepts.
    NameKind.NODE: ((((_ALNUM, 1),), ((_ALNUM | frozenset("_.-"), 1),)), 1),
    # Printable ASCII except the slash.
    NameKind.INTERFACE: ((((_GRAPHIC, 1),), ((_GRAPHIC, 1),)), 1),
    NameKind.SERVICE: (
        (
            ((frozenset("/"), 1),),
            ((_LETTERS | {"_"}, 2),),
            ((_ALNUM | {"_"}, 2), (frozenset("/"), 1)),
        ),
        2,
    ),
}


@functools.lru_cache(maxsize=4096)
def _compiled(patterns: tuple[str, ...]) -> re.Pattern[str]:
    return re.compile("|".join(fnmatch.translate(pattern) for pattern in patterns))


def matches(name: str, patterns: tuple[str, ...]) -> bool:
    """Return whether one of the patterns matches the name."""
    return _compiled(patterns).match(name) is not None


def can_match(pattern: str, kind: NameKind) -> bool:
    """Return whether any valid name matches the pattern: walk through pattern and grammar of names side by side."""
    states, accepting = _STATES[kind]
    units = _units(pattern)
    seen: set[tuple[int, int]] = set()
    frontier = [(0, 0)]
    while frontier:
        here = frontier.pop()
        if here in seen:
            continue
        seen.add(here)
        position, state = here
        if position == len(units):
            if state == accepting:
                return True
            continue
        unit = units[position]
        if unit == "*":
            frontier.append((position + 1, state))
            frontier += [(position, target) for _, target in states[state]]
        else:
            for characters, target in states[state]:
                if any(fnmatch.fnmatchcase(character, unit) for character in characters):
                    frontier.append((position + 1, target))
    return False


def _units(pattern: str) -> list[str]:
    """Cut into parts that match one character each, and stars. An unclosed bracket is a plain character."""
    units: list[str] = []
    position = 0
    while position < len(pattern):
        end = position + 1
        if pattern[position] == "[":
            # A ']' right after the bracket, or after its '!', belongs to the set.
            search = end + 1 if pattern[end : end + 1] == "!" else end
            closing = pattern.find("]", search + 1)
            if closing >= 0:
                end = closing + 1
        units.append(pattern[position:end])
        position = end
    return units


_PLAIN_BEGINNING = re.compile(r"[^*?\[]*")


class PatternIndex:
    """Lists of patterns, numbered from 0."""

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
        """Return the numbers of the lists with a pattern that matches the name."""
        found = set(self._plain.get(name, ()))
        for length in range(len(name) + 1):
            for pattern, number in self._by_beginning.get(name[:length], ()):
                if number not in found and matches(name, (pattern,)):
                    found.add(number)
        return frozenset(found)
