"""Replaces what stands between `<!-- generated: NAME -->` and `<!-- end of generated -->` in a page."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Mapping

_BLOCK = re.compile(r"(<!-- generated: ([\w-]+) -->\n)(?:.*?)(<!-- end of generated -->)", re.DOTALL)


def replace_blocks(page: str, texts: Mapping[str, str]) -> str:
    """Return the page with these texts in its blocks; raise ValueError if it has other blocks or another order."""
    names = [match[2] for match in _BLOCK.finditer(page)]
    if names != list(texts):
        raise ValueError(f"expected the blocks {', '.join(texts)} in this order, got {', '.join(names) or 'none'}")
    return _BLOCK.sub(lambda match: f"{match[1]}\n{texts[match[2]]}\n{match[3]}", page)
