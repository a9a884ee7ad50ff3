"""A CA on disk: what is kept comes back, nothing is ever half written, and nobody else looks in."""

from __future__ import annotations

import contextlib
import os
import stat
import threading
from typing import TYPE_CHECKING

import pytest

from plr.controlplane.ca import Authority, AuthorityError, folder
from plr.controlplane.ca.actions import refuse_taken
from plr.controlplane.ca.files import write_atomically
from plr.controlplane.ca.folder import AuthorityFolder, Protection
from plr.protos.base.errors import ConfigError
from plr.protos.trust.identity import CertificateError, IdentityRole, Trust

if TYPE_CHECKING:
    from pathlib import Path


@pytest.fixture
def kept(tmp_path: Path) -> AuthorityFolder:
    kept = AuthorityFolder(tmp_path / "ca")
    kept.create(Authority.create())
    return kept


def test_what_is_kept_comes_back(kept: AuthorityFolder) -> None:
    with kept.locked() as authority:
        issued = authority.issue("robot-1", IdentityRole.ROBOT)
        authority.rotate("next")
        authority.issue("cloud-1", IdentityRole.CLOUD)
        authority.revoke("robot-1")
        kept.save(authority)
    with kept.locked() as again:
        assert [each.record() for each in (again, *again.former)] == list(kept.records())
        assert [each.record() for each in (again, *again.former)] == [
            each.record() for each in (authority, *authority.former)
        ]
        assert again.ca_pem == authority.ca_pem == (kept.path / "ca.pem").read_bytes()
        again.renew("cloud-1")
    trust = Trust(again.ca_pem, (kept.path / "crl.pem").read_bytes())
    with pytest.raises(CertificateError, match="revoked"):
        trust.check(issued.certificate_der, authority.entries[0].not_before)


def test_nobody_else_may_look(kept: AuthorityFolder) -> None:
    with kept.locked() as authority:
        authority.rotate("next")
        kept.save(authority)
    assert stat.S_IMODE(kept.path.stat().st_mode) == 0o700
    keys = [*kept.path.glob("authorities/*/key.pem")]
    assert len(keys) == 2
    assert {stat.S_IMODE(path.stat().st_mode) for path in (*keys, kept.path / "index.json")} == {0o600}


def test_a_folder_that_others_may_enter_is_refused(kept: AuthorityFolder) -> None:
    kept.path.chmod(0o750)
    with pytest.raises(ConfigError, match="do: chmod 700"), kept.locked():
        pass


def test_a_key_that_others_may_read_is_refused(kept: AuthorityFolder) -> None:
    (key,) = kept.path.glob("authorities/*/key.pem")
    key.chmod(0o640)
    with pytest.raises(ConfigError, match="do: chmod 600"), kept.locked():
        pass


def test_a_ca_is_not_made_over_another(kept: AuthorityFolder) -> None:
    before = (kept.path / "index.json").read_bytes()
    with pytest.raises(ConfigError, match="already holds a CA"):
        kept.create(Authority.create())
    assert (kept.path / "index.json").read_bytes() == before


def test_a_former_ca_goes_with_its_key(kept: AuthorityFolder) -> None:
    with kept.locked() as authority:
        authority.rotate("next")
        kept.save(authority)
        authority.retire()
        kept.save(authority)
    assert [path.name for path in (kept.path / "authorities").iterdir()] == [
        f"{authority.own.certificate.serial_number:x}"
    ]


@pytest.mark.audit("sec-11")
def test_the_keys_of_a_former_ca_are_remembered(kept: AuthorityFolder) -> None:
    with kept.locked() as authority:
        stolen = authority.issue("robot-1", IdentityRole.ROBOT).key
        authority.revoke("robot-1")
        authority.rotate("next")
        authority.retire()
        authority.issue("robot-1", IdentityRole.ROBOT)
        kept.save(authority)
    with kept.locked() as authority, pytest.raises(AuthorityError, match="was revoked"):
        authority.renew("robot-1", key=stolen)


def test_every_nodes_folder_hears_of_a_revocation(kept: AuthorityFolder) -> None:
    with kept.locked() as authority:
        authority.write_tls_dir(kept.node_folder("cp"), "cp", IdentityRole.CONTROL_PLANE)
        authority.issue("robot-1", IdentityRole.ROBOT)
        authority.revoke("robot-1")
        kept.save(authority)
    assert (kept.node_folder("cp") / "crl.pem").read_bytes() == (kept.path / "crl.pem").read_bytes()


def written(path: Path) -> dict[str, tuple[int, int]]:
    return {file.name: (file.stat().st_ino, file.stat().st_mtime_ns) for file in path.iterdir()}


def test_a_nodes_folder_is_not_touched_for_nothing(kept: AuthorityFolder) -> None:
    with kept.locked() as authority:
        authority.write_tls_dir(kept.node_folder("cp"), "cp", IdentityRole.CONTROL_PLANE)
        kept.save(authority)
        before = written(kept.node_folder("cp"))
        authority.issue("robot-1", IdentityRole.ROBOT)
        kept.save(authority)
    assert written(kept.node_folder("cp")) == before


# -- passphrase ----------------------------------------------------------------------------------------------------


def test_a_passphrase_guards_the_key(tmp_path: Path, cheap_guesses: None) -> None:
    AuthorityFolder(tmp_path / "ca", b"secret").create(Authority.create())
    with AuthorityFolder(tmp_path / "ca", b"secret").locked() as authority:
        authority.issue("robot-1", IdentityRole.ROBOT)
    for passphrase, problem in ((None, "give --passphrase-file"), (b"wrong", "another passphrase")):
        with pytest.raises(ConfigError, match=problem), AuthorityFolder(tmp_path / "ca", passphrase).locked():
            pass
    assert len(AuthorityFolder(tmp_path / "ca").records()) == 1


@pytest.mark.audit("sec-11")
def test_a_new_ca_has_its_key_under_the_passphrase_of_the_one_before(tmp_path: Path) -> None:
    kept = AuthorityFolder(tmp_path / "ca", b"secret")
    kept.create(Authority.create())
    with kept.locked() as authority:
        authority.rotate("next")
        kept.save(authority)
    assert kept.protections() == [Protection.GOOD] * 2


@pytest.mark.audit("sec-11")
@pytest.mark.parametrize("before", [None, b"secret"])
@pytest.mark.parametrize("after", [None, b"another"])
@pytest.mark.parametrize("count", [0, 1, 2])
def test_a_change_of_passphrase_that_was_cut_short_can_be_given_again(
    tmp_path: Path,
    cheap_guesses: None,
    monkeypatch: pytest.MonkeyPatch,
    before: bytes | None,
    after: bytes | None,
    count: int,
) -> None:
    kept = AuthorityFolder(tmp_path / "ca", before)
    kept.create(Authority.create())
    with kept.locked() as authority:
        authority.rotate("next")
        kept.save(authority)
    with monkeypatch.context() as cut, contextlib.suppress(Cut):
        cut_at(cut, count)
        kept.change_passphrase(after)
    kept.change_passphrase(after)
    assert kept.protections() == [Protection.CLEAR if after is None else Protection.GOOD] * 2
    with AuthorityFolder(tmp_path / "ca", after).locked() as again:
        assert [each.own.certificate for each in (again, *again.former)] == [
            each.own.certificate for each in (authority, *authority.former)
        ]


@pytest.mark.audit("sec-11")
def test_a_wrong_passphrase_changes_nothing(tmp_path: Path, cheap_guesses: None) -> None:
    AuthorityFolder(tmp_path / "ca", b"secret").create(Authority.create())
    (key,) = tmp_path.glob("ca/authorities/*/key.pem")
    before = key.read_bytes()
    for new in (None, b"another"):
        with pytest.raises(ConfigError, match="another passphrase"):
            AuthorityFolder(tmp_path / "ca", b"wrong").change_passphrase(new)
    assert key.read_bytes() == before


# -- interruptions and company -------------------------------------------------------------------------------------


class Cut(Exception):
    pass


def cut_at(monkeypatch: pytest.MonkeyPatch, count: int) -> None:
    """Let `count` more files be written."""
    left = [count]

    def write(path: Path, data: bytes, mode: int) -> None:
        if left[0] == 0:
            raise Cut
        left[0] -= 1
        write_atomically(path, data, mode)

    monkeypatch.setattr(folder, "write_atomically", write)


@pytest.mark.parametrize("count", range(8))
def test_cut_short_anywhere_a_command_can_be_given_again(
    kept: AuthorityFolder, monkeypatch: pytest.MonkeyPatch, count: int
) -> None:
    with kept.locked() as authority:
        issued = authority.issue("robot-1", IdentityRole.ROBOT)
        kept.save(authority)
    cut_at(monkeypatch, count)
    try:
        with kept.locked() as authority:
            authority.rotate("next")
            authority.revoke("robot-1")
            kept.save(authority)
    except Cut:
        monkeypatch.undo()
        with kept.locked() as authority:
            if not authority.former:
                authority.rotate("next")
            if authority.latest("robot-1").revoked_at is None:
                authority.revoke("robot-1")
            kept.save(authority)
    with kept.locked() as authority:
        assert len(authority.former) == 1
    trust = Trust((kept.path / "ca.pem").read_bytes(), (kept.path / "crl.pem").read_bytes())
    with pytest.raises(CertificateError, match="revoked"):
        trust.check(issued.certificate_der, authority.former[0].entries[0].not_before)


def test_commands_at_the_same_time_lose_nothing(kept: AuthorityFolder) -> None:
    def issue(number: int) -> None:
        with AuthorityFolder(kept.path).locked() as authority:
            authority.issue(f"robot-{number}", IdentityRole.ROBOT)
            kept.save(authority)

    threads = [threading.Thread(target=issue, args=(number,)) for number in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    (record,) = kept.records()
    assert {entry.name for entry in record.entries} == {f"robot-{number}" for number in range(8)}


@pytest.mark.parametrize(
    "index",
    [
        b"",
        b"{}",
        b"[]",
        b'{"authorities": []}',
        b'{"authorities": [{"serial": 1, "crl_number": 0, "entries": []}]}',
        b'{"authorities": [{"serial": "x", "crl_number": 0, "entries": []}]}',
        b'{"authorities": [{"serial": "1", "crl_number": -1, "entries": []}]}',
        b'{"authorities": [{"serial": "1", "crl_number": 0, "entries": [{"name": "a b"}]}]}',
    ],
)
def test_an_index_that_is_none_is_refused(kept: AuthorityFolder, index: bytes) -> None:
    path = kept.path / "index.json"
    path.write_bytes(index)
    with pytest.raises(ConfigError) as caught:
        kept.records()
    assert str(caught.value).startswith(f"{path}: ")
    assert "\n" not in str(caught.value)


@pytest.mark.audit("ops-14")
@pytest.mark.skipif(os.geteuid() != 0, reason="giving files away takes root")
@pytest.mark.parametrize("planted", ["", "nodes"])
def test_no_ca_is_made_in_what_somebody_else_made_first(tmp_path: Path, planted: str) -> None:
    folder = tmp_path / "plr-ca"
    (folder / "nodes").mkdir(parents=True)
    os.chown(folder / planted, 60002, 60003)
    with pytest.raises(ConfigError, match="belongs to user 60002"):
        AuthorityFolder(folder).create(Authority.create())
    assert [path.name for path in folder.iterdir()] == ["nodes"]


@pytest.mark.audit("ops-14")
def test_a_fifo_in_a_nodes_folder_holds_up_nobody(tmp_path: Path) -> None:
    folder = AuthorityFolder(tmp_path / "plr-ca")
    folder.create(Authority.create())
    folder.node_folder("robot-1").mkdir(parents=True)
    for name in ("ca.pem", "cert.pem"):
        os.mkfifo(folder.node_folder("robot-1") / name)
    with folder.locked() as authority:
        (problem,) = folder.save(authority)
        assert "it is not a regular file" in problem
        with pytest.raises(AuthorityError, match="holds another node's files"):
            refuse_taken(folder.node_folder("robot-1"), "robot-1", own=True)
