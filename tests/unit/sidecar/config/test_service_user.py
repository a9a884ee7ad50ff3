"""Whether the account of the service may read what root reads."""

from __future__ import annotations

import os
import pwd
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from plr.sidecar.config import service_user
from plr.sidecar.config.service_user import blocking, unreadable

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
