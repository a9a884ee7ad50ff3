"""Matches names with shell-style patterns, one by one or many at once.

`*` is any text ('/' included), `?` one character, `[ab]` or `[!ab]` one of or none of. Case counts. The dialect is
Python's `fnmatch.fnmatchcase`, as in the sidecars' `services[].name`.

A pattern can only match names that begin with its text before the first special character, and end with its text after
the last one. `PatternIndex` uses this: a fleet with a rule for each robot or each site costs some look-ups of a name's
beginning and end, not a match against each rule.
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
_PLAIN_END = re.compile(r"[^*?]*\Z")
_PLAIN_END_BEHIND_SETS = re.compile(r"[^*?\]]*\Z")


class Glob:
    """A pattern with stars, of which the beginning and the end are known to match; compiled once, when it is made."""

    def __init__(self, pattern: str, beginning: str, end: str) -> None:
        self._ends = len(beginning), len(end)
        self._regular: re.Pattern[str] | None = None
        self._between: tuple[str, ...] = ()
        """Texts that follow each other in any distance, if that is all there is to it: faster than what `re` does."""
        if "?" in pattern or "[" in pattern:
            self._regular = re.compile(fnmatch.translate(pattern))
        else:
            self._between = tuple(filter(None, pattern.split("*")[1:-1]))

    @property
    def always(self) -> bool:
        """Whether nothing is left to compare."""
        return self._regular is None and not self._between

    def matches(self, name: str) -> bool:
        """Return whether it matches a name that begins and ends as it should."""
        if self._regular is not None:
            return self._regular.match(name) is not None
        at, before_end = self._ends[0], len(name) - self._ends[1]
        for text in self._between:
            at = name.find(text, at, before_end)
            if at < 0:
                return False
            at += len(text)
        return True


class PatternIndex:
    """Lists of patterns, numbered from 0."""

    def __init__(self, lists: Iterable[tuple[str, ...]]) -> None:
        numbers: defaultdict[str, set[int]] = defaultdict(set)
        for number, patterns in enumerate(lists):
            for pattern in patterns:
                numbers[pattern].add(number)
        self._plain: dict[str, frozenset[int]] = {}
        """Patterns without special characters."""
        self._by_ends: dict[tuple[int, int], dict[tuple[str, str], list[tuple[Glob | None, frozenset[int]]]]] = {}
        """The others by their plain beginning and end, and these by their lengths; None if these are all there is."""
        for pattern, listed in numbers.items():
            beginning, end = _ends(pattern)
            if beginning == pattern:
                self._plain[pattern] = frozenset(listed)
                continue
            glob = Glob(pattern, beginning, end)
            like = self._by_ends.setdefault((len(beginning), len(end)), {})
            like.setdefault((beginning, end), []).append((None if glob.always else glob, frozenset(listed)))

    def matching(self, name: str) -> frozenset[int]:
        """Return the numbers of the lists with a pattern that matches the name."""
        found = set(self._plain.get(name, ()))
        length = len(name)
        for (begin, end), patterns in self._by_ends.items():
            if begin + end <= length:
                for glob, numbers in patterns.get((name[:begin], name[length - end :]), ()):
                    if glob is None or (not numbers <= found and glob.matches(name)):
                        found |= numbers
        return frozenset(found)


def _ends(pattern: str) -> tuple[str, str]:
    plain_end = _PLAIN_END_BEHIND_SETS if "[" in pattern else _PLAIN_END
    beginning, end = _PLAIN_BEGINNING.match(pattern), plain_end.search(pattern)
    assert beginning is not None
    assert end is not None
    return beginning[0], end[0]
