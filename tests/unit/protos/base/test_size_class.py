from __future__ import annotations

import pytest

from plr.protos.base.size_class import SIZE_CLASSES, size_class


@pytest.mark.parametrize(
    ("size", "expected"),
    [(0, 0), (1, 0), (1024, 0), (1025, 1), (4096, 1), (4097, 2), (120_000, 4), (1 << 20, 5), (1 << 40, 6)],
)
def test_classes_end_where_documented(size: int, expected: int) -> None:
    assert size_class(size) == expected


def test_a_larger_size_is_in_no_lower_class() -> None:
    classes = [size_class(size) for size in range(0, 3_000_000, 997)]
    assert classes == sorted(classes)
    assert set(classes) == set(range(SIZE_CLASSES))
