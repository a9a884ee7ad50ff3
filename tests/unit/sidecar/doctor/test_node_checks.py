"""What is judged of a node without its sidecar: each check is seen to pass and to fail."""

from __future__ import annotations

import os
import time
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from plr.controlplane.ca import Authority
from plr.protos.model.ids import InterfaceName
from plr.protos.program.tls_files import load_tls_files
from plr.protos.trust.identity import IdentityRole
from plr.sidecar.config.unit import installed
from plr.sidecar.doctor import host, node_checks
from plr.sidecar.doctor.finding import Finding, Level
from plr.sidecar.doctor.host import ClockState, reverse_path_filter, unit_environment
from plr.sidecar.net.interfaces import Interface, choose
from plr.sidecar.ros.environment import clock_problem

if TYPE_CHECKING:
    from collections.abc import Iterable

pytestmark = pytest.mark.audit("ops-14")


def now() -> float:
    """When it is asked for: certificates are made in the tests, which may begin long after this file is read."""
    return time.time()


DAY = 86_400.0
LOCALHOST = {"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}


def one(findings: Iterable[Finding]) -> Finding:
    (finding,) = findings
    return finding


def levels(findings: Iterable[Finding]) -> list[Level]:
    found = list(findings)
    assert all(finding.remedy for finding in found if finding.level is not Level.OK)
    return [finding.level for finding in found]


@pytest.fixture
def tls(tmp_path: Path) -> tuple[Authority, Path]:
    authority = Authority.create()
    folder = tmp_path / "tls"
    folder.mkdir()
    authority.write_tls_dir(folder, "robot-7", IdentityRole.ROBOT, days=30.0)
    return authority, folder


def test_a_certificate_in_force(tls: tuple[Authority, Path]) -> None:
    finding = one(node_checks.certificate(load_tls_files(tls[1]), now()))
    assert finding.level is Level.OK
    assert "robot-7, robot, 30 days left, not revoked by the list in use (number 0" in finding.text


def test_one_that_ends_soon_is_warned_of_and_one_that_ended_fails(tls: tuple[Authority, Path]) -> None:
    files = load_tls_files(tls[1])
    assert levels(node_checks.certificate(files, now() + 25 * DAY)) == [Level.WARN]
    ended = one(node_checks.certificate(files, now() + 31 * DAY))
    assert ended.level is Level.FAIL
    assert "plr ca renew robot-7" in ended.remedy


def test_a_revoked_one_fails(tls: tuple[Authority, Path]) -> None:
    authority, folder = tls
    authority.revoke("robot-7")
    (folder / "crl.pem").write_bytes(authority.crl_pem())
    finding = one(node_checks.certificate(load_tls_files(folder), now()))
    assert finding.level is Level.FAIL
    assert "revoked" in finding.text


def test_another_one_in_use_than_on_disk_is_warned_of(tls: tuple[Authority, Path]) -> None:
    files = load_tls_files(tls[1])
    same = {"serial": f"{files.identity.serial:x}"}
    assert levels(node_checks.files_on_disk(files, None, same)) == []
    assert levels(node_checks.files_on_disk(files, None, {"serial": "abc"})) == [Level.WARN]
    assert levels(node_checks.files_on_disk(None, None, {"serial": "abc"})) == [], "not for this user"


@pytest.mark.audit("ops-14")
def test_files_that_the_sidecar_does_not_take() -> None:
    def judged(broken: str | None, **refused: object) -> Finding:
        return one(node_checks.files_on_disk(None, broken, {"serial": "abc", "refused": refused or None}))

    seen = judged("ca.pem: malformed; copy it")
    assert (seen.level, seen.remedy) == (Level.FAIL, "copy it")
    assert seen.text.startswith("ca.pem: malformed; ")
    assert "its next start fails" in seen.text
    assert judged("key.pem: others may read it; do: chmod 600 key.pem").remedy == "chmod 600 key.pem"
    told = judged(None, start=False, text="key.pem: cannot be read: Permission denied; chown plr")
    assert (told.level, told.remedy) == (Level.FAIL, "chown plr")
    assert "its next start fails" in told.text
    older = judged(None, start=True, text="crl.pem: older; copy the newest there")
    assert (older.level, older.remedy) == (Level.WARN, "copy the newest there")
    assert "fails" not in older.text


def test_the_certificate_that_a_sidecar_tells_of() -> None:
    used = {"name": "robot-7", "role": "robot", "not_after": now() + 3 * DAY, "revocation_lists": [], "problem": None}
    assert levels(node_checks.certificate_in_use(used, now())) == [Level.OK]
    problem = {"in_force": False, "text": "cert.pem: expired; renew it"}
    finding = one(node_checks.certificate_in_use({**used, "problem": problem}, now()))
    assert (finding.level, finding.text, finding.remedy) == (Level.FAIL, "cert.pem: expired", "renew it")


@pytest.mark.parametrize(
    ("ahead_s", "state", "level"),
    [
        (-1000.0, ClockState(True, 0.01), Level.OK),
        (100.0, ClockState(True, 0.01), Level.OK),
        (1000.0, ClockState(True, 0.01), Level.FAIL),
        (-1000.0, ClockState(False, 16.0), Level.WARN),
        (-1000.0, None, Level.OK),
    ],
)
def test_the_clock(ahead_s: float, state: ClockState | None, level: Level) -> None:
    assert levels(node_checks.clock(now(), now() + ahead_s, state)) == [level]


def test_a_clock_that_ros_does_not_start_with() -> None:
    finding = one(node_checks.clock(2177452801.0, 0.0, ClockState(True, 0.01)))
    assert finding.level is Level.FAIL
    assert finding.text == "the clock says 2039-01-01, and Fast DDS works only until 2038-01-19"


def test_a_clock_that_keeps_ros_from_starting_is_the_remedy() -> None:
    broken, _ = node_checks.ros(LOCALHOST, LOCALHOST, clock_problem(2177452801.0))
    assert (broken.level, broken.remedy) == (Level.FAIL, "set it: timedatectl set-ntp true, or date -s")


def test_static_peers_that_are_left_out() -> None:
    assert levels(node_checks.static_peers(["planner-host"])) == [Level.WARN]
    assert levels(node_checks.static_peers(())) == []


def test_ros() -> None:
    assert levels(node_checks.ros(LOCALHOST, LOCALHOST, None)) == [Level.OK, Level.OK]
    assert levels(node_checks.ros({}, {}, None)) == [Level.OK, Level.WARN]
    broken, _ = node_checks.ros(LOCALHOST, LOCALHOST, "ROS 2's rclpy is missing for python: pip install it")
    assert broken.level is Level.FAIL
    assert broken.text.endswith("pip install it")
    unit = {"ROS_AUTOMATIC_DISCOVERY_RANGE": "SYSTEM_DEFAULT", "FASTRTPS_DEFAULT_PROFILES_FILE": "/etc/plr/fastdds.xml"}
    assert levels(node_checks.ros(unit, unit, None)) == [Level.OK, Level.OK]
    _, domain = node_checks.ros({**LOCALHOST, "ROS_DOMAIN_ID": "10"}, {}, None)
    assert "this shell: 0" in domain.text


@pytest.mark.parametrize("reach", ["LOCALHOST", "SUBNET"])
def test_users_that_shared_memory_keeps_apart(reach: str) -> None:
    """The doctor said ok, and no call was ever answered."""
    used = {"ROS_AUTOMATIC_DISCOVERY_RANGE": reach, "RMW_IMPLEMENTATION": "rmw_fastrtps_cpp"}
    _, seen = node_checks.ros(used, used, None, of_unit=True, user=65534, others=frozenset({0, 65534}))
    assert seen.level is Level.FAIL
    assert "applications of root get no answer" in seen.text
    assert "remove ROS_AUTOMATIC_DISCOVERY_RANGE from /etc/plr/sidecar.env" in seen.remedy
    assert levels(node_checks.ros(used, used, None, user=65534)) == [Level.OK, Level.WARN]
    assert levels(node_checks.ros(LOCALHOST, LOCALHOST, None, user=1000, others=frozenset({1000}))) == [Level.OK] * 2


def test_a_range_that_finds_nobody_fails() -> None:
    used = {"ROS_AUTOMATIC_DISCOVERY_RANGE": "OFF"}
    assert levels(node_checks.ros(used, used, None)) == [Level.OK, Level.FAIL]


def test_the_advice_under_a_unit_leads_to_its_profile_not_to_localhost() -> None:
    used = {"ROS_AUTOMATIC_DISCOVERY_RANGE": "SUBNET", "FASTRTPS_DEFAULT_PROFILES_FILE": "/etc/plr/fastdds.xml"}
    _, domain = node_checks.ros(used, used, None, of_unit=True, user=999)
    assert (domain.level, "LOCALHOST" in domain.remedy) == (Level.WARN, False)


def test_types() -> None:
    wanted = {"/plan": "nav_msgs/srv/GetPlan", "/look": "my_robot/srv/Look"}
    assert levels(node_checks.types(wanted, {})) == [Level.OK]
    missing, there = node_checks.types(wanted, {"/look": "my_robot/srv/Look"})
    assert (missing.level, there.level) == (Level.FAIL, Level.OK)
    assert "ros-jazzy-my-robot" in missing.remedy


def interface(name: str, **changes: object) -> Interface:
    fields = {"index": 1, "kind": "", "up": True, "carrier": True, "mtu": 1500, "addresses": ("192.0.2.7",),
              "gateways": ((4, "192.0.2.1"),), **changes}  # fmt: skip
    return Interface(name=InterfaceName(name), **fields)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("there", "expected"),
    [
        ([interface("wlan0"), interface("wwan0")], [Level.OK, Level.OK]),
        ([interface("wlan0")], [Level.OK, Level.WARN]),
        ([interface("wlan0"), interface("wwan0", carrier=False)], [Level.OK, Level.WARN]),
        ([interface("wlan0"), interface("wwan0", addresses=())], [Level.OK, Level.WARN]),
        ([interface("wlan0"), interface("wwan0", gateways=())], [Level.OK, Level.OK, Level.WARN]),
        ([interface("wlan0", up=False), interface("wwan0", up=False)], [Level.WARN, Level.WARN, Level.FAIL]),
        ([], [Level.WARN, Level.WARN, Level.FAIL]),
    ],
)
def test_interfaces(there: list[Interface], expected: list[Level]) -> None:
    assert levels(node_checks.interfaces(choose(there, ("wlan0", "wwan0")))) == expected


def test_an_interface_that_the_sidecar_does_not_use_is_not_ok() -> None:
    choice = choose([interface("wlan0"), interface("wwan0")], None)
    assert levels(node_checks.interfaces(choice, {"wlan0", "wwan0"})) == [Level.OK, Level.OK]
    assert levels(node_checks.interfaces(choice, {"wlan0"})) == [Level.OK, Level.WARN]
    assert levels(node_checks.interfaces(choice, {"wlan0"}, {"wwan0": "taken"})) == [Level.OK]


def test_the_reverse_path_filter(tmp_path: Path) -> None:
    assert levels(node_checks.reverse_path({"wlan0": 0, "wwan0": 2})) == [Level.OK]
    assert levels(node_checks.reverse_path({"wlan0": 1})) == [Level.OK]
    finding = one(node_checks.reverse_path({"wlan0": 2, "wwan0": 1}))
    assert finding.level is Level.WARN
    assert "net.ipv4.conf.wwan0.rp_filter=2" in finding.remedy
    for name, value in (("all", "1"), ("wlan0", "0"), ("wwan0", "2")):
        (tmp_path / name).mkdir()
        (tmp_path / name / "rp_filter").write_text(value + "\n")
    assert [reverse_path_filter(name, tmp_path) for name in ("wlan0", "wwan0", "eth9")] == [1, 2, 1]
    assert reverse_path_filter("wlan0", tmp_path / "none") is None


def test_the_environment_of_the_unit_is_read(tmp_path: Path) -> None:
    (tmp_path / "sidecar.env").write_text("# a comment\nROS_DOMAIN_ID=42\nRMW_IMPLEMENTATION='rmw_x'\nnonsense\n")
    (tmp_path / "sidecar.yaml").touch()
    environment = unit_environment(tmp_path / "sidecar.yaml")
    assert not environment.refused
    assert environment.variables["ROS_DOMAIN_ID"] == "42"
    assert environment.variables["RMW_IMPLEMENTATION"] == "rmw_x"


def test_the_environment_of_the_unit_is_not_read_where_others_may_write(tmp_path: Path) -> None:
    config, file = tmp_path / "sidecar.yaml", tmp_path / "sidecar.env"
    config.touch()
    assert not unit_environment(config).refused  # there is none
    file.write_text("PYTHONPATH=/evil\n")
    for path, mode in ((tmp_path, 0o1777), (file, 0o666), (file, 0o664)):
        before = path.stat().st_mode & 0o777
        path.chmod(mode)
        found = unit_environment(config)
        assert "others may write" in found.refused
        assert found.variables.get("PYTHONPATH") != "/evil"
        path.chmod(before)
    assert unit_environment(config).variables["PYTHONPATH"] == "/evil"
    file.write_bytes(b"ROS_DOMAIN_ID=1\0\0")
    assert "it contains a NUL byte" in unit_environment(config).refused


@pytest.mark.skipif(os.geteuid() != 0, reason="only a unit of root counts")
def test_the_environment_of_the_unit_counts_while_the_sidecar_is_stopped(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The doctor judged this shell, and advised what breaks the unit."""
    config, unit = tmp_path / "sidecar.yaml", tmp_path / "plr-sidecar.service"
    config.touch()
    shipped = Path("deploy/systemd/plr-sidecar.service").read_text().replace("/etc/plr/sidecar.yaml", str(config))
    unit.write_text(shipped.replace("User=plr", "User=nobody"))
    monkeypatch.setattr(host, "installed", lambda path: installed(path, [tmp_path]))
    monkeypatch.setenv("ROS_DOMAIN_ID", "7")
    monkeypatch.delenv("ROS_AUTOMATIC_DISCOVERY_RANGE", raising=False)
    found = unit_environment(config)
    assert (found.of_unit, found.user, "ROS_DOMAIN_ID" in found.variables) == (True, 65534, False)
    assert levels(node_checks.ros(found.variables, {}, None, of_unit=True, user=65534)) == [Level.OK, Level.OK]
    (tmp_path / "sidecar.env").write_text("ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST\n")
    found = unit_environment(config)
    assert levels(node_checks.ros(found.variables, {}, None, of_unit=True, user=65534)) == [Level.OK, Level.WARN]
    assert not unit_environment(tmp_path / "other.yaml").of_unit


@pytest.mark.skipif(os.geteuid() != 0, reason="giving a file away takes root")
def test_the_environment_of_another_user_runs_none_of_his_code(tmp_path: Path) -> None:
    config, file = tmp_path / "sidecar.yaml", tmp_path / "sidecar.env"
    config.touch()
    file.write_text("LD_PRELOAD=/evil\nPATH=/evil\nROS_DOMAIN_ID=42\nRMW_IMPLEMENTATION=../../evil\n")
    os.chown(file, 65534, 65534)
    found = unit_environment(config)
    assert "belongs to user 65534, who is not the configuration's owner" in found.refused
    assert found.variables == dict(os.environ)
    os.chown(config, 65534, 65534)
    found = unit_environment(config)
    assert found.refused.endswith("these variables in it are not used: LD_PRELOAD PATH RMW_IMPLEMENTATION")
    assert found.variables == os.environ | {"ROS_DOMAIN_ID": "42"}
