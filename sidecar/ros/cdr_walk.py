"""Checks the lengths in a CDR message and the memory it will take, before a type support may read it.

A type support allocates room for all elements that a length announces before it reads the first one. A length takes
four bytes, and an element of 200 bytes may take as little as one on the wire. So 16 MiB from a peer could become 4 GB
and 14 s on the only ROS thread. This module compares each length with the bytes that are there, using the minimum and
the actual size of what it counts, and adds up the memory of the C message. It allocates nothing but a view.

The layout is plain CDR (XCDR1, DDS-XTypes 1.3 section 7.4.3) as the rmw implementations of ROS 2 write it. Primitives
are aligned to their size, counted from the end of the 4-byte encapsulation header. Strings and sequences begin with a
32-bit length; that of a string includes its NUL.

An honest large message is one long array, or thousands of elements that look alike. So runs of elements with the same
lengths at the same places are skipped at once. The rest is walked step by step, in at most `MAX_WALK_STEPS` steps.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

ENCAPSULATION_BYTES = 4
ALIGNMENT = 8
"""Largest alignment: the size of a fixed layout depends on its start position modulo this."""
MAX_WALK_STEPS = 24_000
"""Lengths checked one by one: some 20 ms, or 21,000 strings of different lengths."""
COMPARISON_STEPS = 8
"""Cost of finding out that no more elements look alike, in steps."""
MAX_ALLOCATIONS = 250_000
"""Strings and sequences of one message, some 30 ms of the type support's time."""
MEMORY_FACTOR = 3
"""Allowed size of a C message as a multiple of its bytes on the wire ..."""
FREE_MEMORY_BYTES = 16 << 20
"""... or this, whichever is more: small messages may consist of many short strings."""
MALLOC_BYTES = 16
"""Minimum overhead of an allocation, and the multiple that its size is rounded up to."""
_FEW, _FIRST_CHUNK = 64, 16
_TRY_AGAIN_AFTER = 64
"""Elements to walk one by one after a block was not followed by any that look alike."""

_BIG_ENDIAN, _LITTLE_ENDIAN = b"\0\0", b"\0\1"


class CdrError(ValueError):
    """The bytes are no message of the type, or it takes too much memory or time; the text says which."""


class Walk:
    """One walk over one message."""

    __slots__ = ("allocations", "bytes", "data", "end", "lengths", "memory", "memory_left", "order", "steps_left")

    def __init__(self, data: memoryview, order: str, memory_bytes: int) -> None:
        self.data = data
        self.bytes = np.frombuffer(data, np.uint8)
        self.end = len(data)
        self.order = "little" if order == "<" else "big"
        self.memory = 0
        """Bytes of the C message so far, its own structure included."""
        self.memory_left = memory_bytes
        self.allocations = 0
        self.steps_left = MAX_WALK_STEPS
        self.lengths: list[int] | None = None
        """Positions of the lengths, while elements are compared."""

    def length(self, position: int) -> tuple[int, int]:
        """Return the length at `position`, once aligned, and where its content begins."""
        position = -(-position // 4) * 4
        begin = position + 4
        if begin > self.end:
            raise CdrError("truncated")
        self.step(1)
        found = int.from_bytes(self.data[position:begin], self.order)  # type: ignore[arg-type]  # one of the two
        if self.lengths is not None:
            self.lengths.append(position)
        return found, begin

    def step(self, steps: int) -> None:
        """Count `steps` steps; raise CdrError beyond MAX_WALK_STEPS."""
        self.steps_left -= steps
        if self.steps_left < 0:
            raise CdrError(f"more than {MAX_WALK_STEPS} strings and sequences of different lengths")

    def note_lengths(self) -> None:
        """Start to note the positions of lengths."""
        self.lengths = []

    def noted_lengths(self) -> list[int] | None:
        """Return the positions noted since `note_lengths`, or None if elements within noted theirs in between."""
        lengths, self.lengths = self.lengths, None
        return lengths

    def take(self, size: int) -> None:
        """Count an allocation of `size` bytes."""
        self.taken(1, MALLOC_BYTES + -(-size // MALLOC_BYTES) * MALLOC_BYTES)

    def taken(self, allocations: int, memory: int) -> None:
        """Count `allocations` allocations with a total of `memory` bytes."""
        self.allocations += allocations
        if self.allocations > MAX_ALLOCATIONS:
            raise CdrError(f"more than {MAX_ALLOCATIONS} strings and sequences")
        self.memory += memory
        if self.memory > self.memory_left:
            raise CdrError(f"takes more than {self.memory_left} bytes of memory")


@dataclass(frozen=True, slots=True)
class Fixed:
    """A layout whose size depends only on the alignment of its start."""

    sizes: tuple[int, ...]
    """Bytes on the wire, leading padding included, by start position modulo ALIGNMENT."""
    struct_bytes: int
    struct_alignment: int

    least: int = 0

    def walk(self, walk: Walk, position: int) -> int:
        """Return where it ends; raises CdrError."""
        position += self.sizes[position % ALIGNMENT]
        if position > walk.end:
            raise CdrError("truncated")
        return position

    def walk_many(self, walk: Walk, position: int, count: int) -> int:
        """Return where `count` of them in a row end; raises CdrError."""
        sizes, begin = self.sizes, position
        # The start positions modulo ALIGNMENT repeat after at most ALIGNMENT elements.
        for _ in range(min(count, ALIGNMENT)):
            position += sizes[position % ALIGNMENT]
        if count > ALIGNMENT:
            cycle = position
            for _ in range(ALIGNMENT):
                cycle += sizes[cycle % ALIGNMENT]
            more = count - ALIGNMENT
            position += more // ALIGNMENT * (cycle - position)
            for _ in range(more % ALIGNMENT):
                position += sizes[position % ALIGNMENT]
        if position > walk.end:
            raise CdrError(f"{count} elements announced, {walk.end - begin} bytes left")
        return position


def primitive(size: int) -> Fixed:
    """Return the layout of a number of `size` bytes."""
    alignment = min(size, ALIGNMENT)
    return Fixed(tuple(-position % alignment + size for position in range(ALIGNMENT)), size, alignment, size)


@dataclass(frozen=True, slots=True)
class String:
    """One-byte characters and their NUL."""

    bound: int | None = None
    struct_bytes: int = 24
    struct_alignment: int = 8
    least: int = 4

    def walk(self, walk: Walk, position: int) -> int:
        """Return where it ends; raises CdrError."""
        size, begin = walk.length(position)
        if size > walk.end - begin:
            raise CdrError(f"a string of {size} bytes, {walk.end - begin} left")
        if self.bound is not None and size > self.bound + 1:
            raise CdrError(f"a string of {size} bytes, but at most {self.bound} are allowed")
        walk.take(size + 1)
        return begin + size


@dataclass(frozen=True, slots=True)
class Structure:
    """Fields in sequence, at least one of which is not fixed."""

    fields: tuple[Layout, ...]
    struct_bytes: int
    struct_alignment: int
    least: int

    def walk(self, walk: Walk, position: int) -> int:
        """Return where it ends; raises CdrError."""
        for field in self.fields:
            position = field.walk(walk, position)
        return position


@dataclass(frozen=True, slots=True)
class Array:
    """A constant number of elements of one layout that is not fixed."""

    element: Layout
    count: int
    struct_bytes: int
    struct_alignment: int
    least: int

    def walk(self, walk: Walk, position: int) -> int:
        """Return where it ends; raises CdrError."""
        return _walk_elements(self.element, walk, position, self.count)


@dataclass(frozen=True, slots=True)
class Elements:
    """A sequence, whose length says how many elements follow."""

    element: Layout
    bound: int | None = None
    struct_bytes: int = 24
    struct_alignment: int = 8
    least: int = 4

    def walk(self, walk: Walk, position: int) -> int:
        """Return where it ends; raises CdrError."""
        count, begin = walk.length(position)
        if count * self.element.least > walk.end - begin:
            raise CdrError(f"{count} elements announced, {walk.end - begin} bytes left")
        if self.bound is not None and count > self.bound:
            raise CdrError(f"{count} elements, but at most {self.bound} are allowed")
        if not count:
            return begin
        walk.take(count * self.element.struct_bytes)
        if isinstance(self.element, Fixed):
            return self.element.walk_many(walk, begin, count)
        return _walk_elements(self.element, walk, begin, count)


Layout = Fixed | String | Structure | Array | Elements


def fixed_structure(fields: Sequence[Layout]) -> Fixed | None:
    """Return the fields as one fixed layout, or None unless all of them are fixed."""
    sizes = []
    for begin in range(ALIGNMENT):
        position = begin
        for field in fields:
            if not isinstance(field, Fixed):
                return None
            position += field.sizes[position % ALIGNMENT]
        sizes.append(position - begin)
    struct_bytes, alignment = _struct(fields)
    return Fixed(tuple(sizes), struct_bytes, alignment, min(sizes))


def structure(fields: Sequence[Layout]) -> Layout:
    """Return the layout of a message with these fields; without any it still takes one byte."""
    fields = fields or (primitive(1),)
    fixed = fixed_structure(fields)
    if fixed is not None:
        return fixed
    struct_bytes, alignment = _struct(fields)
    return Structure(tuple(fields), struct_bytes, alignment, sum(field.least for field in fields))


def array(element: Layout, count: int) -> Layout:
    """Return the layout of an array of `count` elements."""
    struct_bytes = count * element.struct_bytes
    if not isinstance(element, Fixed):
        return Array(element, count, struct_bytes, element.struct_alignment, count * element.least)
    sizes = []
    for begin in range(ALIGNMENT):
        position = begin
        for _ in range(count):
            position += element.sizes[position % ALIGNMENT]
        sizes.append(position - begin)
    return Fixed(tuple(sizes), struct_bytes, element.struct_alignment, min(sizes))


def _struct(fields: Sequence[Layout]) -> tuple[int, int]:
    """Return the size of the C structure in bytes, and its alignment."""
    size, alignment = 0, 1
    for field in fields:
        size = -(-size // field.struct_alignment) * field.struct_alignment + field.struct_bytes
        alignment = max(alignment, field.struct_alignment)
    return -(-size // alignment) * alignment, alignment


def _walk_elements(element: Layout, walk: Walk, position: int, count: int) -> int:
    """Return where `count` elements that are not fixed end; skip together those that look alike."""
    left, patience = count, 0
    while left:
        if patience or left < 2 * ALIGNMENT or (walk.lengths is not None and left <= _FEW):
            # A few elements inside others that are being compared are compared along with them.
            position = element.walk(walk, position)
            left -= 1
            patience = max(0, patience - 1)
            continue
        began, allocations, memory = position, walk.allocations, walk.memory
        walk.note_lengths()
        # After ALIGNMENT elements the next one has the alignment of the first, whatever the size of one.
        for _ in range(ALIGNMENT):
            position = element.walk(walk, position)
        # None: they contained long runs of elements that were compared themselves.
        lengths = walk.noted_lengths()
        left -= ALIGNMENT
        size = position - began
        alike = _alike(walk, began, size, lengths, left // ALIGNMENT) if lengths is not None else 0
        walk.taken(alike * (walk.allocations - allocations), alike * (walk.memory - memory))
        position += alike * size
        left -= alike * ALIGNMENT
        patience = 0 if alike else _TRY_AGAIN_AFTER
    return position


def _alike(walk: Walk, began: int, size: int, lengths: list[int], most: int) -> int:
    """Return how many blocks after the one at `began` have the same lengths at the same places."""
    most = min(most, (walk.end - began) // size - 1)
    where = (np.array(lengths)[:, None] - began + np.arange(4)).reshape(-1)
    first = walk.bytes[began : began + size][where]
    alike, chunk = 0, _FIRST_CHUNK
    # A failed comparison covers no more than about what matched before: hostile bytes must not make this slow.
    while alike < most:
        chunk = min(chunk, most - alike)
        start = began + size * (alike + 1)
        blocks = walk.bytes[start : start + chunk * size].reshape(chunk, size)
        other = (blocks[:, where] != first).any(axis=1)
        found = int(other.argmax())
        same = found if other[found] else chunk
        alike += same
        if same < chunk:
            walk.step(COMPARISON_STEPS)
            break
        chunk *= 2
    return alike


def check(layout: Layout, payload: bytes | memoryview) -> int:
    """Return the memory that the C message in `payload` will take, in bytes.

    Raises:
        CdrError: the bytes are no such message, or it takes too much memory or too long to check.
    """
    if len(payload) < ENCAPSULATION_BYTES:
        raise CdrError("shorter than its header")
    kind = bytes(payload[:2])
    if kind not in (_BIG_ENDIAN, _LITTLE_ENDIAN):
        raise CdrError(f"encapsulation {kind.hex()}, not plain CDR")
    order = "<" if kind == _LITTLE_ENDIAN else ">"
    limit = max(MEMORY_FACTOR * len(payload), FREE_MEMORY_BYTES)
    walk = Walk(memoryview(payload)[ENCAPSULATION_BYTES:], order, limit)
    walk.taken(0, layout.struct_bytes)
    layout.walk(walk, 0)
    return walk.memory
