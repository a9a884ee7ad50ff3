"""The site holds every page, what pages link to, and a navigation that names each page once."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

import yaml

from deploy.dev.site.__main__ import ROOT, tracked
from deploy.dev.site.collection import Collection

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path


def collect(root: Path, texts: dict[str, str]) -> Collection:
    for name, text in texts.items():
        path = root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    return Collection(root, frozenset(texts))


def leaves(entry: object) -> Iterator[str]:
    """Yield the pages of a part of the navigation."""
    match entry:
        case str():
            yield entry
        case dict():
            for inside in entry.values():
                yield from leaves(inside)
        case list():
            for inside in entry:
                yield from leaves(inside)


def navigation() -> list[str]:
    # Not the whole file: a tag in it names a function of a package that only `make docs` installs.
    _, text = (ROOT / "mkdocs.yml").read_text().split("\nnav:\n")
    return list(leaves(yaml.safe_load(text)))


def test_the_navigation_names_every_page_and_no_other() -> None:
    pages = Collection(ROOT, tracked(ROOT)).pages
    assert sorted(navigation()) == sorted(pages)
    in_docs = {str(path.relative_to(ROOT)) for path in (ROOT / "docs").rglob("*.md")}
    assert in_docs == {page for page in pages if page.startswith("docs/")}


def test_every_link_of_the_site_leads_to_a_file_of_it() -> None:
    collection = Collection(ROOT, tracked(ROOT))
    there = {*collection.pages, *collection.views, *collection.data}
    for place, text in {**collection.pages, **collection.views}.items():
        prose = re.sub(r"^ *```.*?^ *```", "", text, flags=re.DOTALL | re.MULTILINE)
        for target in re.findall(r"\]\(([^)\s#]+)", prose):
            if "://" not in target:
                path = (ROOT / place).parent / target
                assert str(path.resolve().relative_to(ROOT)) in there, f"{place}: {target}"


def test_pages_data_and_other_texts_are_collected_with_what_they_link_to(tmp_path: Path) -> None:
    collection = collect(
        tmp_path,
        {
            "README.md": "[a](docs/a.md#part) [tool](tool)",
            "docs/a.md": "[home](../README.md) [how](../HOW.md) [rules](../rules.yml) [web](https://example.org/x)",
            "docs/figure.svg": "<svg/>",
            "HOW.md": "how",
            "rules.yml": "a: 1\n",
            "tool/README.md": "tool",
            "tool/tool.py": "",
            "unlinked.md": "",
        },
    )
    assert collection.pages == {
        "README.md": "[a](docs/a.md#part) [tool](tool/README.md)",
        "docs/a.md": "[home](../README.md) [how](../HOW.md) [rules](../rules.yml.md) [web](https://example.org/x)",
        "HOW.md": "how",
        "tool/README.md": "tool",
    }
    assert collection.data == {"docs/figure.svg"}
    assert collection.views.keys() == {"rules.yml.md"}
    assert collection.views["rules.yml.md"].endswith("# rules.yml\n\n`````yml\na: 1\n`````\n")


def test_a_folder_without_a_readme_is_a_list_of_its_files(tmp_path: Path) -> None:
    collection = collect(
        tmp_path, {"README.md": "[d](docs/d)", "docs/d/1.md": "[all](../d)", "docs/d/e/2.svg": "<svg/>"}
    )
    assert collection.pages == {"README.md": "[d](docs/d/index.md)", "docs/d/1.md": "[all](index.md)"}
    assert collection.views["docs/d/index.md"].endswith("# docs/d\n\n- [1.md](1.md)\n- [e/2.svg](e/2.svg)\n")


def test_a_link_that_leads_nowhere_is_left_for_the_build_to_refuse(tmp_path: Path) -> None:
    collection = collect(tmp_path, {"README.md": "[gone](docs/gone.md) [absent](absent)"})
    assert collection.pages == {"README.md": "[gone](docs/gone.md) [absent](absent)"}
