"""What the site consists of: the pages, and what they link to.

The site has the repository's layout, so that links between pages hold as they are. It starts with README.md and all of
docs/, and adds what these link to: pages as pages, other texts as pages that show them, folders as lists of their
files. So a site needs no public repository to link to, and can be read without a network.
"""

from __future__ import annotations

import re
from pathlib import Path
from posixpath import normpath, relpath

from deploy.dev.site.lists import adapt_lists

# Files that a browser shows or a program reads: these are copied. Other files are text, and become pages.
_DATA = {".json", ".svg", ".xz"}
_LINK = re.compile(r"(?<=\]\()([^)\s#]+)(?=(?:#[^)\s]*)?\))")
_UNSEARCHED = "---\nsearch:\n  exclude: true\n---\n"


class Collection:
    """What the site consists of, by its place in the site.

    `pages` are the pages of the repository, `views` the generated texts of other files and folders, `data` the files
    that are copied.
    """

    def __init__(self, root: Path, files: frozenset[str]) -> None:
        self.pages: dict[str, str] = {}
        self.views: dict[str, str] = {}
        self.data: set[str] = set()
        self._root = root
        self._files = files
        self._add("README.md")
        for file in sorted(files):
            if file.startswith("docs/"):
                self._add(file)

    def _add(self, file: str) -> str:
        """Add a file or folder, and what it links to; return its place."""
        if file not in self._files:
            return self._add_folder(file)
        if file.endswith(".md"):
            if file not in self.pages:
                self.pages[file] = ""  # Pages link to each other.
                text = (self._root / file).read_text(encoding="utf-8")
                self.pages[file] = _LINK.sub(lambda match: self._target(file, match[1]), adapt_lists(text))
            return file
        if Path(file).suffix in _DATA:
            self.data.add(file)
            return file
        place = f"{file}.md"
        if place not in self.views:
            text = (self._root / file).read_text(encoding="utf-8")
            language = Path(file).suffix.removeprefix(".") or "text"
            self.views[place] = f"{_UNSEARCHED}# {file}\n\n`````{language}\n{text.rstrip()}\n`````\n"
        return place

    def _add_folder(self, folder: str) -> str:
        """Add a folder's README, or a list of its files; return its place, or the name of what does not exist."""
        readme = f"{folder}/README.md"
        if readme in self._files:
            return self._add(readme)
        inside = sorted(file for file in self._files if file.startswith(f"{folder}/"))
        if not inside:
            return folder
        place = f"{folder}/index.md"
        if place not in self.views:
            self.views[place] = ""  # A page in the folder may link to the folder.
            items = [f"- [{file.removeprefix(f'{folder}/')}]({relpath(self._add(file), folder)})" for file in inside]
            self.views[place] = f"{_UNSEARCHED}# {folder}\n\n" + "\n".join(items) + "\n"
        return place

    def _target(self, page: str, target: str) -> str:
        """Return what a page has to link to instead of this target."""
        if "://" in target or target.startswith("mailto:"):
            return target
        folder = str(Path(page).parent)
        return relpath(self._add(normpath(f"{folder}/{target}")), folder)
