"""Commands that are cut short, by a full disk or a kill: nothing that nodes may have seen is taken back."""

from __future__ import annotations

import io
import os
import re
import sys
from typing import TYPE_CHECKING

import pytest

from plr.controlplane.ca import Authority, AuthorityError, folder
from plr.controlplane.ca.actions import refuse_taken
from plr.controlplane.ca.files import write_atomically
from plr.controlplane.ca.folder import AuthorityFolder
from plr.controlplane.ca.index import Entry
from plr.controlplane.cli import __main__
from plr.protos.base.errors import ConfigError
from plr.protos.trust.identity import MAX_CA_CERTIFICATES, CertificateError, IdentityRole, Trust
from tests.unit.controlplane.ca.test_authority import DAY_S, Clock

if TYPE_CHECKING:
    from pathlib import Path

    from tests.unit.controlplane.ca.shell import Shell

pytestmark = pytest.mark.audit("sec-11")


@pytest.fixture
def kept(tmp_path: Path) -> AuthorityFolder:
    kept = AuthorityFolder(tmp_path / "ca")
    kept.create(Authority.create())
    return kept


def full_at(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    def write(path: Path, data: bytes, mode: int) -> None:
        if path.name == name:
            raise OSError(28, "No space left on device")
        write_atomically(path, data, mode)

    monkeypatch.setattr(folder, "write_atomically", write)


def test_a_list_that_was_signed_counts_though_the_index_does_not_know_of_it(
    kept: AuthorityFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A node had the first of two lists of one number, and took the second for no news."""
    with kept.locked() as ca:
        issued = {name: ca.issue(name, IdentityRole.ROBOT) for name in ("r7", "r9")}
        kept.save(ca)
    with monkeypatch.context() as patch, kept.locked() as ca:
        full_at("index.json", patch)
        ca.revoke("r7")
        with pytest.raises(OSError, match="No space"):
            kept.save(ca)
    first = Trust(ca.ca_pem, (kept.path / "crl.pem").read_bytes())
    with kept.locked() as ca:
        ca.revoke("r9")
        kept.save(ca)
    second = Trust(ca.ca_pem, (kept.path / "crl.pem").read_bytes())
    (older,), (newer,) = first.lists().values(), second.lists().values()
    assert older is not None
    assert newer is not None
    assert newer.number > older.number
    for one in issued.values():
        with pytest.raises(CertificateError, match="revoked"):
            second.check(one.certificate_der, one.certificate.not_valid_before_utc.timestamp())


def test_a_list_of_another_ca_is_not_taken_over(kept: AuthorityFolder) -> None:
    other = Authority.create()
    other.publish()
    (kept.path / "crl.pem").write_bytes(other.crl_pem() + b"-----BEGIN X509 CRL-----\n-----END X509 CRL-----\n")
    with kept.locked() as ca:
        assert ca.crl_number == 0


def test_an_index_of_a_large_fleet_is_read_again_and_a_full_one_not_written(
    kept: AuthorityFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of 14,230 certificates on, no command worked any more."""
    with kept.locked() as ca:
        ca.issue("r0", IdentityRole.ROBOT)
        (entry,) = ca.entries
        many = [Entry(entry.name, entry.role, number, 0.0, 1.0, key="k" * 64) for number in range(1, 20_001)]
        ca.entries = [*many, entry]
        kept.save(ca)
    with kept.locked() as ca:
        assert len(ca.entries) == 20_001
        ca.revoke("r0")
        monkeypatch.setattr(folder, "MAX_INDEX_BYTES", 1 << 20)
        with pytest.raises(ConfigError, match=r"index.json: it is full; do: plr ca rotate"):
            kept.save(ca)
    monkeypatch.undo()
    assert len(kept.records()[0].entries) == 20_001


@pytest.mark.audit("ops-14")
@pytest.mark.parametrize(
    ("pattern", "value"),
    [
        ('"not_after": [0-9.]*', '"not_after": NaN'),
        ('"not_after": [0-9.]*', '"not_after": 1e300'),
        ('"not_before": [0-9.]*', '"not_before": -1.0'),
        ('"revoked_at": null', '"revoked_at": 1.0'),
        ('"revoked_at": null', '"reason": "x", "revoked_at": Infinity'),
        ('"serial": "[0-9a-f]*"', '"serial": "-1"'),
        ('"crl_number": 0', '"crl_number": 99999999999999999999999999999999999999999999999999'),
    ],
)
def test_an_index_that_somebody_damaged_is_told_in_one_line(
    shell: Shell, tmp_path: Path, pattern: str, value: str
) -> None:
    ca = str(tmp_path / "ca")
    shell("init", "--no-passphrase", "--dir", ca)
    shell("issue", "r1", "--role", "robot", "--dir", ca)
    index = tmp_path / "ca" / "index.json"
    changed, times = re.subn(pattern, value, index.read_text())
    assert times
    index.write_text(changed)
    for command in (("list",), ("publish",), ("issue", "r2", "--role", "robot"), ("revoke", "r1")):
        assert "not what plr ca wrote" in shell(*command, "--dir", ca, code=2)


@pytest.mark.audit("ops-8")
def test_a_fifo_in_the_place_of_a_list_is_not_waited_for(shell: Shell, tmp_path: Path) -> None:
    ca = tmp_path / "ca"
    shell("init", "--no-passphrase", "--dir", str(ca))
    shell("issue", "r1", "--role", "robot", "--dir", str(ca))
    for path in (ca / "crl.pem", ca / "nodes" / "r1" / "crl.pem"):
        path.unlink()
        os.mkfifo(path)
    shell("publish", "--dir", str(ca))
    assert any("r1/crl.pem: could not be updated" in line for line in shell.warnings)
    assert (ca / "crl.pem").is_file()
    os.mkfifo(tmp_path / "request.pem")
    assert "not a regular file" in shell("sign", str(tmp_path / "request.pem"), "--dir", str(ca), code=1)


@pytest.mark.audit("ops-14")
def test_what_is_done_is_not_called_refused_when_it_cannot_be_printed(
    shell: Shell, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    ca = str(tmp_path / "ca")
    shell("init", "--no-passphrase", "--dir", ca)
    for buffering in (-1, 0):
        with io.TextIOWrapper(open("/dev/full", "wb", buffering), write_through=not buffering) as full:
            monkeypatch.setattr(sys, "stdout", full)
            assert __main__.main(["ca", "issue", f"r{buffering}", "--role", "robot", "--dir", ca]) == 0
            monkeypatch.undo()
        error = capsys.readouterr().err.splitlines()[-1]
        assert error.startswith(f"plr: done, but it cannot be printed (No space left on device): issued r{buffering} ")
    assert "r0 " in shell("list", "--dir", ca)


def test_a_folder_that_cannot_be_brought_up_to_date_is_warned_of_and_stops_nothing(
    shell: Shell, tmp_path: Path
) -> None:
    ca = str(tmp_path / "ca")
    shell("init", "--no-passphrase", "--dir", ca)
    shell("issue", "r1", "--role", "robot", "--dir", ca)
    (tmp_path / "ca" / "nodes" / "odd" / "crl.pem").mkdir(parents=True)
    shell("issue", "r2", "--role", "robot", "--dir", ca)
    assert any("nodes/odd/crl.pem: could not be updated: Is a directory" in line for line in shell.warnings)
    assert (tmp_path / "ca" / "nodes" / "r2" / "key.pem").exists()
    shell("revoke", "r1", "--dir", ca)


def test_what_a_killed_command_left_is_swept_out(kept: AuthorityFolder) -> None:
    (own,) = (kept.path / "authorities").iterdir()
    node = kept.node_folder("r1")
    node.mkdir(parents=True)
    left = [own / ".key.pem.abcd1234", kept.path / ".index.json.xy_z0000", node / ".key.pem.aaaaaaaa"]
    mine = [kept.path / ".lock", own / "key.pem", node / ".profile"]
    for path in (*left, mine[2]):
        path.write_text("-----BEGIN PRIVATE KEY-----")
    with kept.locked():
        assert not any(path.exists() for path in left)
        assert all(path.exists() for path in mine)


def test_a_key_without_certificate_in_the_nodes_own_folder_is_of_a_command_cut_short(tmp_path: Path) -> None:
    (tmp_path / "key.pem").write_text("key")
    refuse_taken(tmp_path, "r1", own=True)
    with pytest.raises(AuthorityError, match="holds another node's files"):
        refuse_taken(tmp_path, "r1", own=False)


def test_a_ca_takes_no_folder_that_others_use(tmp_path: Path) -> None:
    (tmp_path / "other").write_text("")
    tmp_path.chmod(0o755)
    with pytest.raises(ConfigError, match="holds other things; a CA needs a --dir of its own"):
        AuthorityFolder(tmp_path).create(Authority.create())
    assert tmp_path.stat().st_mode & 0o777 == 0o755


def test_without_standard_input_or_output_it_neither_asks_nor_fails(
    shell: Shell, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ca = str(tmp_path / "ca")
    with monkeypatch.context() as patch:
        patch.setattr(sys, "stdin", None)
        assert "there is no terminal to ask for it" in shell("init", "--dir", ca, code=2)
        patch.setattr(sys, "stdout", None)
        shell("init", "--no-passphrase", "--dir", ca)
    assert (tmp_path / "ca" / "index.json").exists()


def test_a_list_signed_while_the_clock_was_ahead_does_not_date_the_later_ones() -> None:
    clock = Clock()
    ca = Authority.create(clock=clock)
    for name in ("r1", "r2"):
        ca.issue(name, IdentityRole.ROBOT)
    clock.now += 60 * DAY_S
    ca.revoke("r1")
    clock.now -= 60 * DAY_S
    ca.publish()
    (newest,) = Trust(ca.ca_pem, ca.crl_pem()).lists().values()
    assert newest is not None
    assert newest.signed_at == clock.now
    clock.now += 1
    ca.revoke("r2")
    (newest,) = Trust(ca.ca_pem, ca.crl_pem()).lists().values()
    assert newest is not None
    assert newest.signed_at == clock.now


def test_no_more_cas_than_nodes_believe() -> None:
    ca = Authority.create()
    for _ in range(MAX_CA_CERTIFICATES - 1):
        ca.rotate("next")
    with pytest.raises(AuthorityError, match="do first: plr ca retire"):
        ca.rotate("one more")
    assert len(Trust(ca.ca_pem).lists()) == MAX_CA_CERTIFICATES
