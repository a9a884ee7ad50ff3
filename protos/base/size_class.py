"""Defines classes of payload sizes: requests of one class over one path share their network times.

Class 0 holds what fits in one datagram. Each further class is four times as wide, and the last has no end::

    class         0      1      2       3        4       5      6
    at most    1 KiB  4 KiB  16 KiB  64 KiB  256 KiB  1 MiB   any

The size is that of the request and its answer together, as both cross the same interface.
"""

from __future__ import annotations

SIZE_CLASSES = 7
"""Few classes, so that each collects enough samples; at 10 Mbit/s a step is worth 0.8 s at most."""

_FIRST_BITS = 10
_STEP_BITS = 2


def size_class(size: int) -> int:
    """Return the class of `size` bytes, from 0 to `SIZE_CLASSES` - 1."""
    bits = (max(size, 1) - 1).bit_length()
    return min(max(0, -(-(bits - _FIRST_BITS) // _STEP_BITS)), SIZE_CLASSES - 1)
