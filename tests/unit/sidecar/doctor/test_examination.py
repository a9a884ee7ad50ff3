"""Where the doctor looks for a sidecar, and what it makes of an answer of another version."""

from __future__ import annotations

import errno
import os
import time
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
import yaml

from plr.controlplane.ca import Authority
from plr.protos.base.errors import ConfigError
from plr.protos.program import tls_files
from plr.protos.program.tls_files import load_tls_files
from plr.protos.trust.identity import IdentityRole
from plr.sidecar.doctor import examination
from plr.sidecar.doctor.examination import (
    RUNTIME_SOCKET,
    Where,
    _certificate_and_clock,
    _judged,
    _ros,
    _wrong,
    connect,
    sockets,
)
from plr.sidecar.doctor.finding import Level
from plr.sidecar.doctor.running_checks import paths
from plr.sidecar.local.client import LocalError, LocalRefusedError
from tests.unit.sidecar.configs import ROBOT, parse

if TYPE_CHECKING:
    from typing import Any, NoReturn

    from plr.sidecar.config.sidecar import SidecarConfig

pytestmark = pytest.mark.audit("ops-14")


def test_the_socket_is_where_the_configuration_says() -> None:
    assert sockets(Where(), parse(ROBOT)) == [Path("/var/lib/plr/sidecar.sock"), RUNTIME_SOCKET]
    assert sockets(Where(), parse(ROBOT, local_socket="/run/x.sock")) == [Path("/run/x.sock")]
    assert sockets(Where(), parse(ROBOT, local_socket=None)) == []
    assert sockets(Where(socket=Path("/run/y.sock")), parse(ROBOT)) == [Path("/run/y.sock")]


@pytest.mark.parametrize(
    ("written", "expected"),
    [
        ({"local_socket": "/run/x.sock", "nonsense": 1}, [Path("/run/x.sock")]),
        ({"state_dir": "/srv/plr", "nonsense": 1}, [Path("/srv/plr/sidecar.sock"), RUNTIME_SOCKET]),
        ({"local_socket": 7, "state_dir": []}, [Path("/var/lib/plr/sidecar.sock"), RUNTIME_SOCKET]),
    ],
)
def test_also_where_the_rest_of_it_is_wrong(tmp_path: Path, written: dict[str, Any], expected: list[Path]) -> None:
    path = tmp_path / "sidecar.yaml"
    path.write_text(yaml.safe_dump(written))
    assert sockets(Where(path), None) == expected


def test_under_systemd_it_is_in_the_runtime_folder() -> None:
    config = parse(ROBOT)
    assert config.local_socket_path("/run/plr") == RUNTIME_SOCKET
    assert config.local_socket_path(None) == Path("/var/lib/plr/sidecar.sock")
    assert parse(ROBOT, local_socket=None).local_socket_path("/run/plr") is None


def test_a_member_who_may_not_look_into_the_state_folder_hears_that_nothing_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Client:
        def __init__(self, path: Path, _owners: frozenset[int]) -> None:
            raise (LocalRefusedError if path in refused else LocalError)(f"{path}: no")

    monkeypatch.setattr(examination, "LocalClient", Client)
    config = parse(ROBOT, state_dir=str(tmp_path))
    refused = {tmp_path / "sidecar.sock"}
    with pytest.raises(LocalError, match=rf"{tmp_path}.* and {RUNTIME_SOCKET}") as caught:
        connect(Where(), config)
    assert type(caught.value) is LocalError
    refused.add(RUNTIME_SOCKET)
    with pytest.raises(LocalRefusedError):
        connect(Where(), config)


@pytest.mark.parametrize("wrong", ["sidecar.sock", "", "/" + "x" * 101])
def test_a_path_that_cannot_be_one_is_refused(wrong: str) -> None:
    with pytest.raises(ConfigError, match="local_socket: expected auto, null or an absolute path"):
        parse(ROBOT, local_socket=wrong)


def test_what_another_version_tells_is_a_warning() -> None:
    (finding,) = _judged(lambda state: paths(state, {}), {"paths": [{"interface": "wlan0"}]})
    assert finding.level is Level.WARN
    assert "not understood" in finding.text


def test_a_file_that_is_not_for_this_user_is_no_failure() -> None:
    assert _wrong(ConfigError("x.yaml", "", f"cannot be read: {os.strerror(13)}")).level is Level.WARN
    assert _wrong(ConfigError("x.yaml", "deadline", "unknown key")).level is Level.FAIL


@pytest.fixture
def node(tmp_path: Path) -> tuple[Path, SidecarConfig, dict[str, Any]]:
    """The TLS folder of a robot, its configuration, and what its sidecar tells of the certificate."""
    folder = tmp_path / "tls"
    Authority.create().write_tls_dir(folder, "robot-1", IdentityRole.ROBOT)
    identity = load_tls_files(folder).identity
    used = {
        "name": "robot-1",
        "role": "robot",
        "serial": f"{identity.serial:x}",
        "not_after": identity.not_after,
        "problem": None,
        "refused": None,
        "revocation_lists": [],
    }
    config = parse(ROBOT, state_dir=str(tmp_path)).model_copy(update={"tls_dir": folder})
    return folder, config, {"certificate": used, "clock": {"floor": 0.0}}


@pytest.mark.parametrize("broken", ["ca.pem", "cert.pem", "key.pem", "crl.pem", "."])
def test_broken_files_fail_while_the_sidecar_runs_on_with_the_old_ones(
    node: tuple[Path, SidecarConfig, dict[str, Any]], broken: str
) -> None:
    """Doctor said ok, and the next reboot ended with exit code 2."""
    folder, config, state = node
    levels = [one.level for one in _certificate_and_clock(config, state, time.time()) if one.check == "certificate"]
    assert levels == [Level.OK]
    if broken == ".":
        folder.rename(folder.with_name("elsewhere"))
    else:
        (folder / broken).write_bytes(b"")
    with pytest.raises(ConfigError):
        load_tls_files(folder)
    in_use, found = (one for one in _certificate_and_clock(config, state, time.time()) if one.check == "certificate")
    assert (in_use.level, found.level) == (Level.OK, Level.FAIL)
    assert found.text.startswith(f"{(folder / broken)}: ")
    assert "its next start fails" in found.text
    assert found.remedy


def test_files_that_only_others_may_read_are_judged_by_the_sidecars_word(
    node: tuple[Path, SidecarConfig, dict[str, Any]], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Root opens them all the same, so the system's answer is made up."""
    folder, config, state = node

    def denied(path: Path) -> NoReturn:
        raise PermissionError(errno.EACCES, "Permission denied", str(path))

    monkeypatch.setattr(tls_files, "open_regular", denied)

    def levels() -> list[Level]:
        return [one.level for one in _certificate_and_clock(config, state, time.time()) if one.check == "certificate"]

    assert levels() == [Level.OK]
    state["certificate"]["refused"] = {"start": False, "text": f"{folder}/key.pem: expected a private key in PEM"}
    assert levels() == [Level.OK, Level.FAIL]


@pytest.mark.parametrize(
    ("problem", "installed", "expected"),
    [
        (None, True, (Level.OK, "installed: /plan (nowhere_msgs/srv/Absent)")),
        (None, False, (Level.FAIL, "/plan: its type nowhere_msgs/srv/Absent is not installed in the sidecar's")),
        (
            "ROS 2's rclpy is missing",
            False,
            (Level.WARN, "not checked, because ROS does not work here: /plan (nowhere"),
        ),
    ],
)
def test_a_configured_type_is_looked_for_before_any_server_offered_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, problem: str | None, installed: bool, expected: tuple[Level, str]
) -> None:
    monkeypatch.setattr("plr.sidecar.ros.environment.problem", lambda *_, **__: problem)
    monkeypatch.setattr(examination, "_is_installed", lambda _: installed)
    services = [{"name": "/plan", "deadline_ms": 100, "type": "nowhere_msgs/srv/Absent"}]
    config = parse(ROBOT, services=services, state_dir=str(tmp_path))
    (found,) = [one for one in _ros(Where(tmp_path / "sidecar.yaml"), config, None) if one.check == "types"]
    assert found.level is expected[0]
    assert found.text.startswith(expected[1])
