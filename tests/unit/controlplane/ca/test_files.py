"""A reader finds the old file or the new one, and a key is never wider open than it shall be."""

from __future__ import annotations

import os
import stat
from typing import TYPE_CHECKING

import pytest

from plr.controlplane.ca import Authority
from plr.controlplane.ca.files import write_atomically, write_tls_files
from plr.protos.trust.identity import IdentityRole

if TYPE_CHECKING:
    from pathlib import Path


def mode(path: Path) -> int:
    return stat.S_IMODE(path.stat().st_mode)


@pytest.mark.parametrize("wanted", [0o600, 0o644])
def test_the_mode_is_the_wanted_one_whatever_the_umask(tmp_path: Path, wanted: int) -> None:
    before = os.umask(0o077)
    try:
        write_atomically(tmp_path / "file", b"new", wanted)
    finally:
        os.umask(before)
    assert mode(tmp_path / "file") == wanted


def test_a_file_is_replaced_and_not_written_over(tmp_path: Path) -> None:
    path = tmp_path / "file"
    path.write_bytes(b"old")
    with path.open("rb") as reader:
        write_atomically(path, b"new", 0o644)
        assert reader.read() == b"old"
    assert path.read_bytes() == b"new"


def test_what_fails_leaves_the_old_file_and_nothing_else(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "file"
    path.write_bytes(b"old")

    def full(descriptor: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="No space left"):
        write_atomically(path, b"new", 0o600)
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]


def test_the_key_is_its_owners_alone(tmp_path: Path) -> None:
    ca = Authority.create()
    write_tls_files(tmp_path / "tls", ca.issue("robot-1", IdentityRole.ROBOT), ca.ca_pem, ca.crl_pem())
    assert mode(tmp_path / "tls") == 0o700
    assert {path.name: mode(path) for path in (tmp_path / "tls").iterdir()} == {
        "ca.pem": 0o644,
        "cert.pem": 0o644,
        "crl.pem": 0o644,
        "key.pem": 0o600,
    }


@pytest.mark.skipif(os.geteuid() != 0, reason="giving files away takes root")
def test_root_renews_what_a_service_reads(tmp_path: Path) -> None:
    ca = Authority.create()
    tmp_path.chmod(0o755)
    folder = tmp_path / "tls"
    folder.mkdir()
    os.chown(folder, 60002, 60003)
    write_tls_files(folder, ca.issue("robot-1", IdentityRole.ROBOT), ca.ca_pem, ca.crl_pem())
    assert {(path.stat().st_uid, path.stat().st_gid) for path in folder.iterdir()} == {(60002, 60003)}


@pytest.mark.audit("ops-14")
@pytest.mark.skipif(os.geteuid() != 0, reason="giving files away takes root")
def test_no_key_goes_to_a_folder_that_anybody_may_have_made(tmp_path: Path) -> None:
    ca = Authority.create()
    tmp_path.chmod(0o1777)
    folder = tmp_path / "tls"
    folder.mkdir()
    os.chown(folder, 60002, 60003)
    with pytest.raises(OSError, match="it belongs to user 60002"):
        write_tls_files(folder, ca.issue("robot-1", IdentityRole.ROBOT), ca.ca_pem, ca.crl_pem())
    assert list(folder.iterdir()) == []
