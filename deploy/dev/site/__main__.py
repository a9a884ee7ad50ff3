"""Writes the site's sources: python -m deploy.dev.site FOLDER"""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

from deploy.dev.site.collection import Collection

ROOT = Path(__file__).parents[3]


def tracked(root: Path) -> frozenset[str]:
    """Return the files of the repository, relative to its top, also new ones that git does not ignore."""
    command = ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
    listed = subprocess.run(command, cwd=root, check=True, capture_output=True, text=True).stdout  # noqa: S603
    return frozenset(name for name in listed.split("\0") if (root / name).is_file())


def write(collection: Collection, root: Path, folder: Path) -> None:
    """Write the collection into a new folder."""
    for place, text in {**collection.pages, **collection.views}.items():
        path = folder / place
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")
    for file in collection.data:
        path = folder / file
        path.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(root / file, path)


def main(arguments: list[str]) -> int:
    """Collect into the folder that is named; return the exit code."""
    if len(arguments) != 1:
        sys.stderr.write("usage: python -m deploy.dev.site FOLDER\n")
        return 2
    folder = Path(arguments[0])
    shutil.rmtree(folder, ignore_errors=True)
    write(Collection(ROOT, tracked(ROOT)), ROOT, folder)
    shutil.copytree(Path(__file__).parent / "assets", folder / "assets")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
