"""Blocks of a page are replaced, and nothing else."""

from __future__ import annotations

import pytest

from deploy.dev.pages.blocks import replace_blocks

PAGE = (
    "before\n\n<!-- generated: a -->\nold\n<!-- end of generated -->\n\nbetween\n\n"
    "<!-- generated: b -->\n<!-- end of generated -->\nafter\n"
)


def test_the_text_around_blocks_stays() -> None:
    page = replace_blocks(PAGE, {"a": "new\n", "b": "new too\n"})
    assert page == (
        "before\n\n<!-- generated: a -->\n\nnew\n\n<!-- end of generated -->\n\nbetween\n\n"
        "<!-- generated: b -->\n\nnew too\n\n<!-- end of generated -->\nafter\n"
    )
    assert replace_blocks(page, {"a": "new\n", "b": "new too\n"}) == page


@pytest.mark.parametrize("names", ["a", "ba", "abc"])
def test_a_page_with_other_blocks_is_refused(names: str) -> None:
    with pytest.raises(ValueError, match="got a, b"):
        replace_blocks(PAGE, dict.fromkeys(names, ""))


def test_a_page_without_blocks_is_refused() -> None:
    with pytest.raises(ValueError, match="got none"):
        replace_blocks("text\n", {"a": ""})
