"""Writes the pages, or compares them with what the code says.

python -m deploy.dev.pages           write docs/use/configuration.md and docs/operate/limits.md
python -m deploy.dev.pages --check   exit 1 if they differ
"""

from __future__ import annotations

import sys

from deploy.dev.pages.configuration import with_keys
from deploy.dev.pages.limits import ROOT, with_figures

PAGES = {"docs/use/configuration.md": with_keys, "docs/operate/limits.md": with_figures}


def main(arguments: list[str]) -> int:
    """Write or check every page; return the exit code."""
    if arguments not in ([], ["--check"]):
        sys.stderr.write("usage: python -m deploy.dev.pages [--check]\n")
        return 2
    status = 0
    for name, generate in PAGES.items():
        path = ROOT / name
        page = path.read_text(encoding="utf-8")
        try:
            fresh = generate(page)
        except ValueError as error:
            sys.stderr.write(f"{name}: {error}\n")
            status = 1
            continue
        if fresh == page:
            continue
        if arguments:
            sys.stderr.write(f"{name} does not say what the code says; run: make pages\n")
            status = 1
        else:
            path.write_text(fresh, encoding="utf-8")
    return status


sys.exit(main(sys.argv[1:]))
