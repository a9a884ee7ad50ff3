"""Whether the account of the service may read what root reads."""

from __future__ import annotations

import os
import pwd
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from plr.sidecar.config import service_user
from plr.sidecar.config.service_user import blocking, unreadable, unreadable_program
from plr.sidecar.config.unit import Unit

if TYPE_CHECKING:
    from collections.abc import Iterator

pytestmark = [
    pytest.mark.audit("ops-14"),
    pytest.mark.skipif(os.geteuid() != 0, reason="giving a file away takes root"),
]

NOBODY = pwd.getpwnam("nobody")


@pytest.fixture
def node(monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A folder that everybody may enter (pytest's own are private), with files of root alone."""
    monkeypatch.setattr(service_user, "ACCOUNT", "nobody")
    monkeypatch.setattr(service_user, "installed", lambda _: None)
    with tempfile.TemporaryDirectory() as made:
        folder = Path(made)
        folder.chmod(0o755)
        (folder / "sidecar.yaml").touch(0o644)
        (folder / "tls").mkdir(0o700)
        for name in ("cert.pem", "key.pem", "ca.pem"):
            (folder / "tls" / name).touch(0o600)
        yield folder


def test_files_of_root_are_not_for_the_service(node: Path) -> None:
    config, tls = node / "sidecar.yaml", node / "tls"
    found = unreadable(config, tls)
    assert found is not None
    assert found.text == f"the account nobody, which runs the service, may not read {tls}"
    assert found.remedy == f"chown -R nobody {tls}"
    tls.chmod(0o755)
    found = unreadable(config, tls)
    assert found is not None
    assert found.text.endswith(f"may not read {tls}/cert.pem, {tls}/key.pem, {tls}/ca.pem")
    assert found.remedy == f"chown -R nobody {tls}"
    for path in tls.iterdir():
        os.chown(path, NOBODY.pw_uid, -1)
    assert unreadable(config, tls) is None
    config.chmod(0o600)
    found = unreadable(config, tls)
    assert found is not None
    assert found.remedy == f"chown nobody {config}"


def test_a_group_may_read_and_an_owner_may_be_shut_out(node: Path) -> None:
    key = node / "tls" / "key.pem"
    (node / "tls").chmod(0o711)
    key.chmod(0o640)
    assert blocking([key], NOBODY.pw_uid, {1}) == [key]
    assert blocking([key], NOBODY.pw_uid, {0}) == []
    os.chown(key, NOBODY.pw_uid, -1)
    key.chmod(0o044)
    assert blocking([key], NOBODY.pw_uid, {0}) == [key]
    assert blocking([key], 0, {0}) == []
    assert blocking([node / "tls" / "none.pem"], NOBODY.pw_uid, {0}) == []


def test_a_folder_on_the_way_is_not_given_away(node: Path) -> None:
    node.chmod(0o700)
    found = unreadable(node / "sidecar.yaml", node / "tls")
    assert found is not None
    assert found.text.endswith(f"may not read {node}")
    assert "chown" not in found.remedy


def test_without_such_an_account_nothing_is_said(node: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(service_user, "ACCOUNT", "no-such-account")
    assert unreadable(node / "sidecar.yaml", node / "tls") is None


@pytest.fixture
def program(node: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An environment made with umask 077, which the installed unit starts."""
    prefix = node / "opt"
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", prefix], check=True, umask=0o077)
    packages = next(prefix.glob("lib/python3*/site-packages"))
    (packages / "plr").mkdir(0o755)
    (packages / "plr" / "__init__.py").touch(0o644)
    (packages / "sdnotify.py").touch(0o644)
    (prefix / "bin" / "plr-sidecar").touch(0o755)
    unit = Unit(node / "plr-sidecar.service", "nobody", command=f"{prefix}/bin/plr-sidecar --config x")
    monkeypatch.setattr(service_user, "installed", lambda _: unit)
    return prefix


def test_a_program_installed_with_umask_077_is_not_for_the_service(program: Path) -> None:
    found = unreadable_program(program / "x")
    assert found is not None
    assert found.text == (
        f"the account nobody, which runs the service, may not read {program}, as after an installation with umask 077: "
        "the service does not start"
    )
    assert found.remedy == f"chmod -R a+rX {program}"
    subprocess.run(found.remedy.split(), check=True)
    assert unreadable_program(program / "x") is None


def test_one_package_that_was_upgraded_with_umask_077_is_found(program: Path) -> None:
    subprocess.run(["chmod", "-R", "a+rX", program], check=True)
    package = next(program.glob("lib/python3*/site-packages/plr"))
    for changed, mode in ((package, 0o700), (package / "__init__.py", 0o600), (package.parent / "sdnotify.py", 0o600)):
        before = changed.stat().st_mode
        changed.chmod(mode)
        found = unreadable_program(program / "x")
        assert found is not None
        assert f"may not read {changed}, " in found.text
        changed.chmod(before)
    assert unreadable_program(program / "x") is None


def test_an_unreadable_profile_of_the_unit_is_named_by_itself(program: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    subprocess.run(["chmod", "-R", "a+rX", program], check=True)
    profile = program.parent / "fastdds.xml"
    profile.touch(0o600)
    unit = Unit(profile, "nobody", {"FASTRTPS_DEFAULT_PROFILES_FILE": str(profile)}, f"{program}/bin/plr-sidecar")
    monkeypatch.setattr(service_user, "installed", lambda _: unit)
    found = unreadable_program(program / "x")
    assert found is not None
    assert found.remedy == f"chmod a+rX {profile}"


def test_without_a_unit_only_the_documented_place_is_judged(node: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (node / "bin").mkdir()
    (node / "bin" / "plr-sidecar").touch(0o700)
    (node / "bin" / "plr-sidecar").chmod(0o700)
    assert unreadable_program(node / "sidecar.yaml") is None
    monkeypatch.setattr(service_user, "PREFIX", node)
    monkeypatch.setattr(sys, "prefix", str(node))
    found = unreadable_program(node / "sidecar.yaml")
    assert found is not None
    assert str(node / "bin" / "plr-sidecar") in found.text
