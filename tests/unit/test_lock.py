"""The locked dependencies are those that pyproject.toml asks for, pinned and hashed, from no registry in particular."""

from __future__ import annotations

import importlib.metadata
import re
import tomllib
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from packaging.version import Version

ROOT = Path(__file__).parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
RUNTIMES = {
    "runtime.txt": [],
    "runtime-sidecar.txt": ["sidecar"],
    "runtime-ros.txt": ["sidecar", "ros"],
    "runtime-controlplane.txt": ["controlplane"],
}
ADDED = {"docs.txt": ["docs"]}
"""What is no part of dev.txt: a target of its own installs it."""
LOCKS = ("dev.txt", *RUNTIMES, *ADDED, "build.txt", "bootstrap.txt")
PIN = re.compile(r"^([A-Za-z0-9._-]+)(?:\[[^]]*\])?==(\S+)(?: ; (.*?))? \\$", re.MULTILINE)

Pins = dict[str, set[Version]]


def pins(name: str) -> Pins:
    """Locked versions by package; several where they depend on the Python version."""
    found: Pins = {}
    for package, version, _ in PIN.findall((ROOT / "requirements" / name).read_text()):
        found.setdefault(canonicalize_name(package), set()).add(Version(version))
    return found


def unmet(requirements: list[str], locked: Pins) -> list[str]:
    """Requirements that no locked version fits, or that some locked version does not fit."""
    missing = []
    for requirement in map(Requirement, requirements):
        versions = locked.get(canonicalize_name(requirement.name), set())
        if not versions or not all(version in requirement.specifier for version in versions):
            missing.append(str(requirement))
    return missing


def test_everything_asked_for_is_locked() -> None:
    asked = [*PROJECT["dependencies"]]
    for extra, requirements in PROJECT["optional-dependencies"].items():
        if [extra] not in ADDED.values():
            asked += requirements
    assert not unmet(asked, pins("dev.txt")), "run: make lock"


@pytest.mark.parametrize("lock", RUNTIMES)
def test_each_runtime_is_locked_at_the_same_versions(lock: str) -> None:
    asked = [*PROJECT["dependencies"]]
    for extra in RUNTIMES[lock]:
        asked += PROJECT["optional-dependencies"][extra]
    runtime, everything = pins(lock), pins("dev.txt")
    assert not unmet(asked, runtime), "run: make lock"
    assert all(everything[package] == versions for package, versions in runtime.items())


@pytest.mark.parametrize("lock", ADDED)
def test_what_is_added_to_the_environment_changes_nothing_in_it(lock: str) -> None:
    asked = [requirement for extra in ADDED[lock] for requirement in PROJECT["optional-dependencies"][extra]]
    added, everything = pins(lock), pins("dev.txt")
    assert not unmet(asked, added), "run: make lock"
    assert len(unmet(asked, everything)) == len(asked), "make setup would install it"
    assert all(added[package] == versions for package, versions in everything.items() if package in added)


@pytest.mark.audit("ops-9")
def test_a_robot_installs_no_solver_and_beside_a_ros_of_its_own_nothing_of_ros() -> None:
    for lock in ("runtime-sidecar.txt", "runtime-ros.txt"):
        assert not {"ortools", "pandas"} & pins(lock).keys()
    own = pins("runtime-sidecar.txt")
    assert "numpy" not in own, "it would hide the one that apt's ROS was built with"
    assert not any(package.startswith("ros-") for package in own)


@pytest.mark.audit("ops-8")
def test_a_build_that_sees_the_system_s_packages_finds_a_packaging_that_setuptools_takes() -> None:
    asked = [
        str(requirement)
        for requirement in map(Requirement, importlib.metadata.requires("setuptools") or [])
        if requirement.name == "packaging" and "core" in str(requirement.marker)
    ]
    assert asked
    assert not unmet(asked, pins("build.txt")), "run: make lock"
    assert unmet(asked, {"packaging": {Version("24.0")}}), "Ubuntu 24.04's would do: lock none"


def test_what_is_not_locked_is_noticed() -> None:
    locked = {"grpcio": {Version("1.81.2")}}
    assert unmet(["grpcio>=1.80", "grpcio>=1.82", "absent"], locked) == ["grpcio>=1.82", "absent"]


@pytest.mark.parametrize("name", LOCKS)
def test_every_line_is_pinned_and_hashed(name: str) -> None:
    text = (ROOT / "requirements" / name).read_text()
    entries = re.split(r"(?m)^(?=[A-Za-z])", "\n".join(line for line in text.splitlines() if line[:1] != "#"))
    entries = [entry for entry in entries if entry.strip()]
    assert len(entries) == sum(len(versions) for versions in pins(name).values())
    assert all(re.search(r"--hash=sha256:[0-9a-f]{64}", entry) for entry in entries)


@pytest.mark.parametrize("name", LOCKS)
def test_no_registry_is_named(name: str) -> None:
    text = (ROOT / "requirements" / name).read_text()
    assert not re.search(r"https?:|file:|--(extra-)?index-url|--find-links|--index", text)


@pytest.mark.parametrize("page", ["deploy/README.md", "deploy/dev/setup.sh"])
def test_nothing_is_installed_but_by_its_hash(page: str) -> None:
    lines = (ROOT / page).read_text().splitlines()
    locked = [line for line in lines if "-r requirements/" in line]
    own = [line for line in lines if re.search(r"install\b.* \.$", line) or line.endswith("--editable .")]
    assert len(locked) >= 2
    assert len(own) == 1
    assert all("--require-hashes" in line for line in locked)
    assert all("--no-deps" in line for line in own)


def test_the_site_s_builder_is_installed_by_its_hash() -> None:
    lines = (ROOT / "deploy/dev/docs.sh").read_text().splitlines()
    (installs,) = [line for line in lines if " install " in line]
    assert "--require-hashes -r requirements/docs.txt" in installs
