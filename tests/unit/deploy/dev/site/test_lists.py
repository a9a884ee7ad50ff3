"""Lists become what Python-Markdown takes for lists; all else stays."""

from __future__ import annotations

import pytest

from deploy.dev.site.lists import adapt_lists


@pytest.mark.parametrize(
    ("page", "adapted"),
    [
        ("text\n- a\n- b\n\nmore", "text\n\n- a\n- b\n\nmore"),
        ("- a\n  wrapped\n- b", "- a\n    wrapped\n- b"),
        ("- a\n\n  more\n- b\n- c", "- a\n\n    more\n\n- b\n- c"),
        ("1. a\n\n   ```sh\n   b\n   ```\n\n2. c", "1. a\n\n    ```sh\n    b\n    ```\n\n2. c"),
        ("- a\n\ntext\n- b", "- a\n\ntext\n\n- b"),
        ("- a\n  - b", "- a\n    - b"),
    ],
)
def test_a_list_is_adapted(page: str, adapted: str) -> None:
    assert adapt_lists(page) == adapted


@pytest.mark.parametrize("page", ["```\nx\n- a\n  b\n```\n", "````\n```\nx\n- a\n````\n", "| a |\n| - |\n", "a\n  b\n"])
def test_all_else_stays(page: str) -> None:
    assert adapt_lists(page) == page
