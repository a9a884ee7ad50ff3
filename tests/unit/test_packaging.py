"""The wheel holds what the checkout holds and says of which commit it is; each program needs its extra alone."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from plr.protos.program import commit, extras

if TYPE_CHECKING:
    from collections.abc import Sequence

ROOT = Path(__file__).parents[2]

SOLVER = ("ortools", "pandas", "grpc_health", "grpc_reflection")
_COMMAND = {"plr.protos.program.command_line": ("doctor",), "plr.controlplane.cli": ("status",)}
SIDECAR = ("pyroute2", "sdnotify", "zfec", "prometheus_client")


def without(absent: Sequence[str], code: str, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Run `code` with these arguments where these packages cannot be imported."""
    hide = f"import runpy, sys\nfor name in {absent!r}: sys.modules[name] = None\n"
    argv = [sys.executable, "-c", hide + code, *arguments]
    return subprocess.run(argv, capture_output=True, text=True, timeout=60, check=False, cwd=ROOT)


def start(module: str, absent: Sequence[str], *arguments: str) -> subprocess.CompletedProcess[str]:
    """Run `python -m module` there."""
    return without(absent, f"runpy.run_module({module!r}, run_name='__main__', alter_sys=True)", *arguments)


@pytest.mark.audit("ops-9")
@pytest.mark.ros
def test_a_sidecar_needs_nothing_of_the_control_plane() -> None:
    done = without(SOLVER, "import plr.sidecar.__main__, plr.sidecar.runtime")
    assert done.returncode == 0, done.stderr


@pytest.mark.audit("ops-9")
def test_a_sidecar_has_no_numpy_but_that_of_ros() -> None:
    modules = sorted(
        ".".join(("plr", *file.relative_to(ROOT).with_suffix("").parts))
        for folder in ("sidecar/core", "sidecar/net")
        for file in (ROOT / folder).rglob("*.py")
    )
    code = "h = Histogram(); h.record(1.0); h.merge(h.copy()); h.to_sparse()"
    counted = f"from plr.protos.base.histogram import Histogram\n{code}"
    done = without(
        ("numpy", *SOLVER), f"import {', '.join(modules)}, plr.sidecar.observe.metrics\n{counted}; h.quantile(0.5)"
    )
    assert done.returncode == 0, done.stderr


@pytest.mark.audit("ops-9")
def test_an_operator_needs_no_extra() -> None:
    code = """
import contextlib, io
from plr.controlplane.cli.__main__ import main
for line in ("status --help", "explain --help", "events --help", "plan --help", "ca --help", "policy --help"):
    with contextlib.suppress(SystemExit), contextlib.redirect_stdout(io.StringIO()):
        main(line.split())
sys.exit(main(["config", "schema", "sidecar"]))
"""
    done = without(("numpy", *SOLVER, *SIDECAR), code)
    assert done.returncode == 0, done.stderr


@pytest.mark.audit("ops-9")
@pytest.mark.parametrize(
    ("module", "name", "absent", "extra"),
    [
        ("plr.controlplane", "plr-controlplane", ("ortools", "sdnotify"), "controlplane"),
        ("plr.sidecar", "plr-sidecar", ("zfec",), "sidecar"),
    ],
)
def test_a_program_without_its_extra_says_which(module: str, name: str, absent: tuple[str, ...], extra: str) -> None:
    done = start(module, absent, "--config", "none.yaml")
    assert done.returncode == 2
    what = f"{', '.join(absent)} not installed: needs the extra {extra}; in the checkout: pip install '.[{extra}]'"
    assert done.stderr == f"{name}: {what}\n"


@pytest.mark.audit("ops-4")
@pytest.mark.parametrize(
    ("module", "name", "extra", "absent"),
    [
        ("plr.controlplane", "plr-controlplane", "controlplane", "cryptography"),
        ("plr.sidecar", "plr-sidecar", "sidecar", "yaml"),
        ("plr.protos.program.command_line", "plr", "sidecar", "pydantic"),
        ("plr.controlplane.cli", "plr", "controlplane", "grpc"),
    ],
)
def test_a_program_without_a_dependency_says_what_to_install(module: str, name: str, extra: str, absent: str) -> None:
    """Even where it takes all that it prints from modules that need it."""
    done = start(module, (absent,), *_COMMAND.get(module, ()), "--help")
    assert done.returncode == 2
    what = f"{absent} not installed: needs the extra {extra}; in the checkout: pip install '.[{extra}]'"
    assert done.stderr == f"{name}: {what}\n"


@pytest.mark.audit("ops-9")
def test_planning_without_its_extra_says_which() -> None:
    done = start("plr.controlplane.cli", ("numpy",), "plan", "--recorded", "none.json")
    assert done.returncode == 2
    assert done.stderr == (
        "plr plan: numpy not installed: needs the extra controlplane; in the checkout: pip install '.[controlplane]'\n"
    )


@pytest.mark.audit("ops-9")
def test_the_extras_are_what_their_programs_ask_for() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]

    def modules(requirements: list[str]) -> set[str]:
        names = {re.split(r"[<>=\[ ]", requirement)[0] for requirement in requirements}
        return {name.replace("grpcio-", "grpc-").removesuffix("-checking").replace("-", "_") for name in names}

    assert modules(project["optional-dependencies"]["sidecar"]) == set(extras.SIDECAR)
    assert modules(project["optional-dependencies"]["controlplane"]) == set(extras.CONTROL_PLANE)


# ── the wheel ──


def git(folder: Path, *arguments: str) -> str:
    who = ("-c", "user.name=tester", "-c", "user.email=tester@example.org")
    return subprocess.run(["git", *who, *arguments], cwd=folder, check=True, capture_output=True, text=True).stdout


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    """A small one: what builds the wheel, and a package of two modules."""
    folder = tmp_path / "checkout"
    for name in (
        "setup.py",
        "pyproject.toml",
        "README.md",
        "LICENSE",
        "protos/program/commit.py",
        "protos/__init__.py",
    ):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(ROOT / name, folder / name)
    (folder / "sidecar").mkdir()
    for name in ("__init__.py", "stays.py", "goes.py"):
        (folder / "sidecar" / name).touch()
    (folder / "plr").mkdir()
    shutil.copy(ROOT / "plr/__init__.py", folder / "plr")
    for name in ("protos", "sidecar"):
        (folder / "plr" / name).symlink_to(f"../{name}")
    return folder


def build(checkout: Path) -> Path:
    """Return the wheel that is made of it."""
    code = "import sys; from setuptools import build_meta; print(build_meta.build_wheel(sys.argv[1]))"
    argv = [sys.executable, "-W", "ignore", "-c", code, str(checkout.parent)]
    done = subprocess.run(argv, cwd=checkout, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0, done.stderr
    return checkout.parent / done.stdout.splitlines()[-1]


def content(wheel: Path) -> dict[str, str]:
    with zipfile.ZipFile(wheel) as archive:
        return {name: archive.read(name).decode() for name in archive.namelist()}


@pytest.mark.audit("ops-10")
def test_a_wheel_holds_no_module_that_is_gone(checkout: Path) -> None:
    assert "plr/sidecar/goes.py" in content(build(checkout))
    (checkout / "sidecar/goes.py").unlink()
    # As an earlier setuptools, or another version of ours, left it.
    left = checkout / "build/lib/plr/sidecar/left.py"
    left.parent.mkdir(parents=True)
    left.touch()
    held = content(build(checkout))
    assert "plr/sidecar/stays.py" in held
    assert not {"plr/sidecar/goes.py", "plr/sidecar/left.py"} & held.keys()


def test_a_wheel_owns_one_name_alone(checkout: Path) -> None:
    """PyPI has packages called `sidecar` and `protos`: in one environment with ours, neither replaces the other."""
    tops = {name.partition("/")[0] for name in content(build(checkout))}
    assert {top for top in tops if not top.endswith(".dist-info")} == {"plr"}


def test_text_files_in_place_of_the_links_become_links(checkout: Path) -> None:
    """A zip archive has them, and a checkout with core.symlinks=false."""
    for name in ("protos", "sidecar"):
        (checkout / "plr" / name).unlink()
        (checkout / "plr" / name).write_text(f"../{name}")
    assert "plr/sidecar/stays.py" in content(build(checkout))
    assert (checkout / "plr/sidecar").readlink() == Path("../sidecar")


def test_a_copy_in_place_of_a_link_is_refused(checkout: Path) -> None:
    """An edit of the source would not be in the wheel."""
    (checkout / "plr/sidecar").unlink()
    shutil.copytree(checkout / "sidecar", checkout / "plr/sidecar")
    done = subprocess.run(
        [sys.executable, "setup.py", "--version"], cwd=checkout, capture_output=True, text=True, check=False
    )
    assert done.returncode == 1
    assert "plr/sidecar is a copy of" in done.stderr
    assert "git checkout -- plr" in done.stderr


def test_a_package_of_the_same_name_behind_ours_is_not_taken(tmp_path: Path) -> None:
    other = tmp_path / "plr"
    other.mkdir()
    (other / "__init__.py").touch()
    code = f"import sys; sys.path.append({str(tmp_path)!r}); import plr.protos.program.commit as it; print(it.__file__)"
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


@pytest.mark.audit("ops-10")
def test_a_wheel_names_its_commit_and_licence(checkout: Path) -> None:
    git(checkout, "init", "--quiet")
    git(checkout, "add", ".")
    git(checkout, "commit", "--quiet", "--message", "all")
    head = git(checkout, "rev-parse", "--short=12", "HEAD").strip()
    held = content(build(checkout))
    assert held["plr/protos/program/commit.txt"] == f"{head}\n"
    assert not (checkout / "protos/program/commit.txt").exists(), "it would go on to say so of later commits"
    metadata = next(text for name, text in held.items() if name.endswith("/METADATA"))
    assert "\nLicense-Expression: Apache-2.0\n" in metadata
    assert any(name.endswith("/licenses/LICENSE") for name in held)


@pytest.mark.audit("ops-10")
def test_without_git_a_wheel_names_no_commit(checkout: Path) -> None:
    # Inside another project's checkout, whose commit is not ours.
    git(checkout.parent, "init", "--quiet")
    git(checkout.parent, "commit", "--quiet", "--allow-empty", "--message", "another")
    assert "plr/protos/program/commit.txt" not in content(build(checkout))


@pytest.mark.audit("ops-10")
def test_a_checkout_asks_git_and_does_without(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", "")
    assert commit.commit.__wrapped__() is None
    monkeypatch.setattr(commit, "commit", lambda: "0123456789ab")
    assert commit.version().endswith("+0123456789ab")
