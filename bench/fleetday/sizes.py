"""Measures the tables of an object: everything reachable from its attributes is counted once.

A table is a dictionary, list, set or deque. It is named by the attributes that lead to it, with `[]` for an element of
a table. So tables of one kind, such as those of every robot, are counted together.
"""

from __future__ import annotations

import enum
import math
import sys
from collections import deque
from dataclasses import dataclass, field
from types import ModuleType
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

OURS = ("bench.", "plr.", "tests.")
"""Modules whose objects are examined."""


@dataclass(slots=True)
class Sizes:
    """The counts of one measurement."""

    entries: dict[str, int] = field(default_factory=dict)
    """Entries in the tables of each name."""
    bytes: dict[str, int] = field(default_factory=dict)
    """Bytes of everything below each attribute of the object itself."""

    @property
    def total_bytes(self) -> int:
        """Bytes of everything."""
        return sum(self.bytes.values())


def measure(root: object) -> Sizes:
    """Count what is reachable from an object."""
    sizes = Sizes()
    seen = {id(root)}
    for attribute, value in _attributes(root):
        below = 0
        waiting: list[tuple[object, str]] = [(value, attribute)]
        while waiting:
            one, name = waiting.pop()
            if id(one) in seen or _is_shared(one):
                continue
            seen.add(id(one))
            below += sys.getsizeof(one)
            if isinstance(one, dict):
                sizes.entries[name] = sizes.entries.get(name, 0) + len(one)
                inner = name + "[]"
                waiting.extend((key, inner) for key in one)
                waiting.extend((element, inner) for element in one.values())
            elif isinstance(one, (list, set, frozenset, deque)):
                if not isinstance(one, frozenset):
                    sizes.entries[name] = sizes.entries.get(name, 0) + len(one)
                waiting.extend((element, name + "[]") for element in one)
            elif isinstance(one, tuple):
                waiting.extend((element, name) for element in one)
            elif type(one).__module__.startswith(OURS):
                waiting.extend((element, f"{name}.{inner}") for inner, element in _attributes(one))
        sizes.bytes[attribute] = below
    return sizes


def _is_shared(one: object) -> bool:
    """Return whether an object belongs to the program and not to a table."""
    return one is None or isinstance(one, (bool, type, enum.Enum, ModuleType)) or callable(one)


def _attributes(one: object) -> Iterator[tuple[str, object]]:
    yield from getattr(one, "__dict__", {}).items()
    for kind in type(one).__mro__:
        slots = getattr(kind, "__slots__", ())
        for slot in (slots,) if isinstance(slots, str) else slots:
            if slot not in ("__dict__", "__weakref__") and hasattr(one, slot):
                yield slot, getattr(one, slot)


def grown(samples: list[Sizes], *, share: float, slack: int, capped: Mapping[str, int]) -> list[str]:
    """Return the tables that grew from the first half of the samples to the second by more than a share and some slack.

    Tables with a cap may grow up to it; the tables inside them are judged by their size for each entry.
    """
    found = []
    half = len(samples) // 2
    for name in sorted({name for sizes in samples for name in sizes.entries}):
        counts = [sizes.entries.get(name, 0) for sizes in samples]
        outer = next((table for table in capped if name.startswith(table + "[]")), None)
        if name in capped:
            if max(counts) > capped[name]:
                found.append(f"{name} is above its cap of {capped[name]}: {counts}")
            continue
        each = [sizes.entries[outer] if outer and sizes.entries.get(outer) else 1 for sizes in samples]
        shares = [count / holders for count, holders in zip(counts, each, strict=True)]
        many = min(counts[half:]) > max(counts[:half], default=math.inf) * (1.0 if outer else 1.0 + share) + slack
        if many and min(shares[half:]) > max(shares[:half]) * (1.0 + share):
            found.append(f"{name} grows: {counts}" + ("" if outer is None else f", in {each} entries of {outer}"))
    return found
