"""What is read of the installed unit, and what is not."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from plr.sidecar.config.unit import NAME, installed

pytestmark = [
    pytest.mark.audit("ops-14"),
    pytest.mark.skipif(os.geteuid() != 0, reason="only a unit of root counts"),
]

CONFIG = Path("/etc/plr/sidecar.yaml")
SHIPPED = Path("deploy/systemd/plr-sidecar.service")


def test_the_shipped_unit(tmp_path: Path) -> None:
    assert installed(CONFIG, [tmp_path]) is None
    (tmp_path / NAME).write_text(SHIPPED.read_text())
    unit = installed(CONFIG, [tmp_path / "none", tmp_path])
    assert unit is not None
    assert unit.user == "plr"
    assert unit.environment["ROS_AUTOMATIC_DISCOVERY_RANGE"] == "SYSTEM_DEFAULT"
    assert unit.environment["FASTRTPS_DEFAULT_PROFILES_FILE"] == "/etc/plr/fastdds.xml"
    assert unit.environment["ROS_LOG_DIR"] == "/var/log/plr"
    assert installed(Path("/elsewhere.yaml"), [tmp_path]) is None


def test_drop_ins_change_it(tmp_path: Path) -> None:
    (tmp_path / NAME).write_text(SHIPPED.read_text())
    folder = tmp_path / f"{NAME}.d"
    folder.mkdir()
    (folder / "10.conf").write_text("[Service]\nUser=robot\nEnvironment=\nEnvironment=\"A=b c\" 'D=e' F=%i\n")
    (folder / "20.conf").write_text("[Service]\nExecStart=\nExecStart=/x --config=/srv/a.yaml \\\n  --more\n")
    unit = installed(Path("/srv/a.yaml"), [tmp_path])
    assert unit is not None
    assert (unit.user, unit.environment, unit.unread) == ("robot", {"A": "b c", "D": "e"}, "")


def test_a_file_that_others_may_write_does_not_count(tmp_path: Path) -> None:
    path = tmp_path / NAME
    path.write_text(SHIPPED.read_text())
    path.chmod(0o666)
    assert installed(CONFIG, [tmp_path]) is None
    path.unlink()
    path.symlink_to("/dev/null")
    assert installed(CONFIG, [tmp_path]) is None, "masked"
