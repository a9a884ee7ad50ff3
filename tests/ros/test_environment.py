"""What a ROS environment that cannot work is told, in one line and with exit code 2."""

from __future__ import annotations

import os
import subprocess
import sys
from importlib.machinery import EXTENSION_SUFFIXES
from typing import TYPE_CHECKING

import pytest

from plr.sidecar.__main__ import main
from plr.sidecar.ros import environment

if TYPE_CHECKING:
    from pathlib import Path

pytestmark = [pytest.mark.ros, pytest.mark.audit("ops-4")]


@pytest.mark.parametrize("domain", ["", "0", "42", "232"])
def test_domains_that_exist(domain: str) -> None:
    assert environment.problem({"ROS_DOMAIN_ID": domain}) is None


@pytest.mark.parametrize("domain", ["abc", "300", "233", "-1", "4.5", " 1", "²"])
def test_domains_that_do_not(domain: str) -> None:
    assert environment.problem({"ROS_DOMAIN_ID": domain}) == (
        f"ROS_DOMAIN_ID: expected a number from 0 to 232, got {domain!r}"
    )


def test_an_rmw_that_is_not_installed_is_named() -> None:
    told = environment.problem({**os.environ, "RMW_IMPLEMENTATION": "rmw_nowhere_cpp"})
    assert told == (
        "RMW_IMPLEMENTATION: 'rmw_nowhere_cpp' is not installed here; unset it to use rmw_fastrtps_cpp, or "
        "install it with ROS from apt: ros-jazzy-rmw-nowhere-cpp"
    )


def test_this_environment_works() -> None:
    assert environment.problem(thorough=True) is None
    assert environment.problem({**os.environ, "RMW_IMPLEMENTATION": environment.DEFAULT_RMW}, thorough=True) is None


def test_without_rclpy_it_says_where_to_get_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    told = environment.problem()
    assert told is not None
    assert told.startswith(
        f"ROS 2's rclpy is missing for {sys.executable}: with ROS from apt, first source /opt/ros/jazzy/"
    )


@pytest.mark.audit("ops-8")
@pytest.mark.parametrize(
    ("machine", "told"),
    [
        ("x86_64", "without it, in the checkout: pip install '.[ros]'"),
        ("aarch64", "without it, install it: it has no wheel for aarch64 (docs/start/install.md, ROS from apt)"),
    ],
)
def test_wheels_of_ros_are_offered_only_where_there_are_some(
    monkeypatch: pytest.MonkeyPatch, machine: str, told: str
) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    monkeypatch.setattr("platform.machine", lambda: machine)
    assert (environment.problem() or "").endswith(told)


@pytest.mark.audit("ops-8")
def test_an_rclpy_of_another_python_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path / "rclpy"
    folder.mkdir()
    (folder / "__init__.py").touch()
    (folder / "_rclpy_pybind11.cpython-399-aarch64-linux-gnu.so").touch()
    monkeypatch.delitem(sys.modules, "rclpy", raising=False)
    monkeypatch.syspath_prepend(tmp_path)
    told = environment.problem({})
    assert told is not None
    assert told.startswith(f"ROS 2's rclpy in {folder} was not built for {sys.executable}, which is Python 3.")
    assert "/usr/bin/python3 -m venv --system-site-packages" in told


@pytest.mark.parametrize("check", [True, False])
def test_the_program_ends_with_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], check: bool
) -> None:
    config = tmp_path / "sidecar.yaml"
    config.write_text(
        "name: robot-1\nrole: robot\ninsecure: true\ncontrol_plane: 127.0.0.1:1\ninterfaces: [lo]\n"
        f"state_dir: {tmp_path}\nservices: [{{name: /plan, deadline_ms: 100}}]\n"
    )
    monkeypatch.setenv("ROS_DOMAIN_ID", "abc")
    assert main(["--config", str(config), *(["--check-config"] if check else [])]) == 2
    shown = capsys.readouterr()
    assert shown.err == "plr-sidecar: ROS_DOMAIN_ID: expected a number from 0 to 232, got 'abc'\n"


@pytest.mark.parametrize("check", [True, False])
def test_a_library_that_rclpy_does_not_find_is_named_in_one_line(tmp_path: Path, check: bool) -> None:
    """As with ROS from apt and no LD_LIBRARY_PATH."""
    config = tmp_path / "sidecar.yaml"
    config.write_text(
        "name: robot-1\nrole: robot\ninsecure: true\ncontrol_plane: 127.0.0.1:1\ninterfaces: [lo]\n"
        f"state_dir: {tmp_path}\nservices: [{{name: /plan, deadline_ms: 100}}]\n"
    )
    (tmp_path / "rclpy").mkdir()
    (tmp_path / "rclpy" / "__init__.py").write_text(
        "raise ImportError('librcl.so: cannot open shared object file: No such file or directory\\nsee elsewhere')\n"
    )
    (tmp_path / "rclpy" / f"_rclpy_pybind11{EXTENSION_SUFFIXES[0]}").touch()
    argv = [sys.executable, "-m", "plr.sidecar", "--config", str(config), *(["--check-config"] if check else [])]
    environ = {**os.environ, "PYTHONPATH": str(tmp_path)}
    done = subprocess.run(argv, env=environ, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 2
    assert done.stderr == (
        "plr-sidecar: ROS 2 does not start here: ImportError: librcl.so: cannot open shared object file: No such file "
        "or directory; with ROS from apt, first source /opt/ros/jazzy/setup.bash (for the unit: LD_LIBRARY_PATH in "
        "/etc/plr/sidecar.env, deploy/README.md)\n"
    )
