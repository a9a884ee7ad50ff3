"""What pyproject.toml has no words for: a wheel says which commit it was made of, and holds no module that is gone."""

from __future__ import annotations

import atexit
import runpy
import shutil
import sys
import tempfile
from pathlib import Path

from setuptools import setup
from setuptools.command.build import build
from setuptools.command.build_py import build_py
from setuptools.command.sdist import sdist

ROOT = Path(__file__).resolve().parent


def link_packages(folder: Path) -> None:
    """Let `plr/NAME` lead to the top-level folder of that name, as in git.

    A zip archive, or a checkout with `core.symlinks=false`, has a text file in place of each link. In a source
    distribution the packages themselves lie in `plr`, and nothing at the top.
    """
    for name in ("controlplane", "protos", "sidecar"):
        package, source = folder / "plr" / name, folder / name
        if package.is_symlink() or not source.is_dir():
            continue
        if package.is_dir():
            sys.exit(f"{package} is a copy of {source}, which it must be a link to; do: rm -r plr; git checkout -- plr")
        package.unlink(missing_ok=True)
        package.symlink_to(Path("..", name), target_is_directory=True)


link_packages(ROOT)
COMMIT = runpy.run_path(str(ROOT / "plr" / "protos" / "program" / "commit.py"))


def stamp(folder: Path) -> None:
    """Leave the commit beside the module that reads it."""
    commit = COMMIT["commit"]()
    file = folder / "plr" / "protos" / "program" / COMMIT["STAMP"]
    # A source distribution may have made it a hard link to the one that it came with.
    file.unlink(missing_ok=True)
    if commit is not None:
        file.write_text(f"{commit}\n")


class FreshBuild(build):
    """Builds in a folder of its own: what an earlier build left in `build/` would get into the wheel."""

    def initialize_options(self) -> None:
        super().initialize_options()
        self.build_base = tempfile.mkdtemp(prefix="fogros2-plr-build-")
        atexit.register(shutil.rmtree, self.build_base, ignore_errors=True)


class StampedBuild(build_py):
    """Stamps what is copied; an editable install asks git."""

    def run(self) -> None:
        super().run()
        if not self.editable_mode:
            stamp(Path(self.build_lib))


class StampedSource(sdist):
    """Stamps the source distribution: no git is asked where that is built."""

    def make_release_tree(self, base_dir: str, files: list[str]) -> None:
        super().make_release_tree(base_dir, files)
        stamp(Path(base_dir))


setup(cmdclass={"build": FreshBuild, "build_py": StampedBuild, "sdist": StampedSource})
