"""One lab for each test file, its links as at the start for each test."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from lab import Lab

if TYPE_CHECKING:
    from collections.abc import Iterator


@pytest.fixture(scope="module")
def shared_lab() -> Iterator[Lab]:
    """The default lab, kept for the whole file; tests use `lab`."""
    with Lab(seed=1) as running:
        yield running


@pytest.fixture
def lab(shared_lab: Lab) -> Lab:
    """The default lab with clean links."""
    for link in shared_lab.links.values():
        link.reset()
    return shared_lab
