"""Stores an evaluation in the repository: its data, its summary, and the figures within README and docs.

A figure stands in a page between `<!-- evaluation: NAME -->` and `<!-- end -->`; `blocks` makes the text between them
from `docs/develop/results/evaluation.json`. A test makes it again and compares: no figure is edited by hand.
"""

from __future__ import annotations

import hashlib
import json
import re
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from bench.evaluation.blocks import all_blocks

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

RESULTS = Path("docs/develop/results")
DATA, SUMMARY, RECORDS = "evaluation.json", "evaluation.md", "records.tar.xz"
PAGES = ("README.md", "docs/*/*.md")
FILES = "files"
"""Key of the data that holds the hash of each other published file, so that an edited one is noticed."""
_BLOCK = re.compile(r"(<!-- evaluation: ([\w-]+) -->\n)(.*?)(<!-- end -->)", re.DOTALL)
_MARK = re.compile(r"<!-- (?:evaluation: |end -->)")
_NUMBER = re.compile(r"\d+(?:[.,]\d+)*")


@dataclass(frozen=True, slots=True)
class Written:
    """A written file."""

    file: Path
    about: str


def pages(root: Path) -> dict[Path, str]:
    """Return the pages with figures of an evaluation, and their text."""
    found = {file: file.read_text(encoding="utf-8") for pattern in PAGES for file in sorted(root.glob(pattern))}
    return {file: text for file, text in found.items() if _MARK.search(text)}


def filled(text: str, blocks: Mapping[str, str]) -> str:
    """Return a page with its figures; raises ValueError for unpaired marks, or a name that no block has."""
    whole = _BLOCK.findall(text)
    if len(_MARK.findall(text)) != 2 * len(whole):
        raise ValueError("expected `<!-- evaluation: NAME -->` and `<!-- end -->` in turn, each on a line of its own")
    unknown = sorted({name for _, name, _, _ in whole} - blocks.keys())
    if unknown:
        raise ValueError(f"no figures are called {', '.join(unknown)}; there are {', '.join(blocks)}")
    return _BLOCK.sub(lambda found: f"{found[1]}\n{blocks[found[2]]}\n\n{found[4]}", text)


def publish(
    root: Path, content: Mapping[str, Any], summary: str, charts: Mapping[str, bytes], records: bytes
) -> list[Written]:
    """Write an evaluation into a checkout; `charts` by their paths beside the summary, `records` packed.

    Raises ValueError before anything is written if the checkout has no pages for the figures or a page's marks are
    wrong; the text names the page.
    """
    blocks = all_blocks(content)
    texts = _filled_pages(root, blocks)
    others = {SUMMARY: summary.encode(), RECORDS: records, **charts}
    data = {**content, FILES: {name: hashlib.sha256(data).hexdigest() for name, data in others.items()}}
    folder = root / RESULTS
    for old in folder.glob("*/*.svg"):
        old.unlink()
    for name, written in {DATA: (json.dumps(data, indent=1) + "\n").encode(), **others}.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(written)
    for file, text in texts.items():
        file.write_text(text, encoding="utf-8")
    size = sum(map(len, charts.values())) // 1000
    about = {
        DATA: f"{len(content['runs'])} windows",
        SUMMARY: f"{len(charts)} charts beside it, {size} kB",
        RECORDS: f"{len(records) // 1000} kB",
    }
    return [
        *(Written(folder / name, text) for name, text in about.items()),
        *(Written(file, _counted(text)) for file, text in texts.items()),
    ]


def _filled_pages(root: Path, blocks: Mapping[str, str]) -> dict[Path, str]:
    found = {}
    for file, text in pages(root).items():
        try:
            found[file] = filled(text, blocks)
        except ValueError as error:
            raise ValueError(f"{file}: {error}") from None
    shown = {name for text in found.values() for _, name, _, _ in _BLOCK.findall(text)}
    missing = [name for name in blocks if name not in shown]
    if missing:
        raise ValueError(f"{root}: expected a checkout whose README.md or docs show {', '.join(missing)}")
    return found


def _counted(text: str) -> str:
    blocks: Sequence[tuple[str, str, str, str]] = _BLOCK.findall(text)
    figures = sum(len(_NUMBER.findall(block)) for _, _, block, _ in blocks)
    return f"{figures} figures in {', '.join(name for _, name, _, _ in blocks)}"
