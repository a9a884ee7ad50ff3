"""`plr ca` as a user meets it: what it writes is a node's tls_dir, and every error is one line with its exit code."""

from __future__ import annotations

import re
import shutil
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from plr.controlplane.ca.passphrase import NEW_VARIABLE, VARIABLE
from plr.controlplane.cli import __main__
from plr.protos.program.tls_files import load_tls_files
from plr.protos.trust.identity import CertificateError, IdentityRole

if TYPE_CHECKING:
    from tests.unit.controlplane.ca.shell import Shell


@pytest.mark.parametrize("role", [role.value for role in IdentityRole])
def test_what_is_issued_is_a_tls_dir(shell: Shell, tmp_path: Path, role: str) -> None:
    shell("init", "--no-passphrase", "--name", "warehouse")
    assert "plr-ca/nodes/node-1" in shell("issue", "node-1", "--role", role)
    identity = load_tls_files(tmp_path / "plr-ca" / "nodes" / "node-1").identity
    assert (identity.name, identity.role.value) == ("node-1", role)


def test_a_certificate_is_renewed_in_its_place(shell: Shell, tmp_path: Path) -> None:
    out = tmp_path / "tls"
    shell("init", "--no-passphrase")
    shell("issue", "robot-1", "--role", "robot", "--days", "1", "--out", str(out))
    first = load_tls_files(out)
    shell("renew", "robot-1", "--out", str(out))
    second = load_tls_files(out)
    assert second.identity.not_after > first.identity.not_after
    assert second.key_pem != first.key_pem
    shell("renew", "robot-1", "--keep-key", "--out", str(out))
    third = load_tls_files(out)
    assert third.key_pem == second.key_pem
    assert third.identity.serial != second.identity.serial


def test_a_revoked_node_is_in_the_list_that_is_to_be_copied(shell: Shell, tmp_path: Path) -> None:
    shell("init", "--no-passphrase")
    shell("issue", "cp", "--role", "controlplane")
    shell("issue", "robot-1", "--role", "robot")
    robot = load_tls_files(tmp_path / "plr-ca/nodes/robot-1")
    assert "plr-ca/crl.pem" in shell("revoke", "robot-1", "--reason", "keyCompromise")
    control_plane = load_tls_files(tmp_path / "plr-ca/nodes/cp")
    with pytest.raises(CertificateError, match="revoked"):
        control_plane.trust.check(robot.certificate_der, robot.identity.not_before)


def test_a_published_list_is_newer_and_says_the_same(shell: Shell, tmp_path: Path) -> None:
    shell("init", "--no-passphrase")
    shell("issue", "robot-1", "--role", "robot")
    shell("issue", "robot-2", "--role", "robot")
    shell("revoke", "robot-1")
    before = load_tls_files(tmp_path / "plr-ca/nodes/robot-2").trust
    assert "plr-ca/crl.pem" in shell("publish")
    after = load_tls_files(tmp_path / "plr-ca/nodes/robot-2").trust
    (old,), (new,) = before.lists().values(), after.lists().values()
    assert old is not None
    assert new is not None
    assert new.number == old.number + 1
    assert new.signed_at >= old.signed_at
    robot = load_tls_files(tmp_path / "plr-ca/nodes/robot-1")
    with pytest.raises(CertificateError, match="revoked"):
        after.check(robot.certificate_der, robot.identity.not_before)
    shell("revoke", "robot-2")
    (last,) = load_tls_files(tmp_path / "plr-ca/nodes/robot-1").trust.lists().values()
    assert last is not None
    assert last.number == new.number + 1


def test_the_list_shows_everything(shell: Shell) -> None:
    shell("init", "--no-passphrase", "--name", "warehouse")
    shell("issue", "robot-2", "--role", "robot", "--days", "30")
    shell("issue", "robot-1", "--role", "robot")
    shell("renew", "robot-2", "--days", "60")
    shell("revoke", "robot-1", "--reason", "superseded")
    header, *rows = (line.split() for line in shell("list").splitlines())
    assert header == ["NAME", "ROLE", "SERIAL", "VALID", "UNTIL", "DAYS", "LEFT", "STATE"]
    shown = [(row[0], row[1], row[4], " ".join(row[5:])) for row in rows]
    assert shown[0] == ("warehouse", "CA", "3650.0", "in use")
    assert shown[1][:3] == ("robot-1", "robot", "-")
    assert shown[1][3].startswith("revoked ")
    assert shown[1][3].endswith("(superseded)")
    assert shown[2:] == [("robot-2", "robot", "30.0", "valid, renewed"), ("robot-2", "robot", "60.0", "valid")]


def test_a_ca_is_rotated(shell: Shell, tmp_path: Path) -> None:
    shell("init", "--no-passphrase")
    shell("issue", "cp", "--role", "controlplane")
    old = load_tls_files(tmp_path / "plr-ca/nodes/cp")
    shell("rotate", "--name", "next")
    assert "renew or revoke them first: cp" in shell("retire", code=1)
    between = load_tls_files(tmp_path / "plr-ca/nodes/cp")
    assert between.ca_pem == (tmp_path / "plr-ca/ca.pem").read_bytes() != old.ca_pem
    shell("renew", "cp")
    shell("retire")
    new = load_tls_files(tmp_path / "plr-ca/nodes/cp")
    between.trust.check(new.certificate_der, new.identity.not_before)
    with pytest.raises(CertificateError, match="another CA"):
        new.trust.identify(old.certificate_der)


def test_what_is_refused_says_what_to_do(shell: Shell, tmp_path: Path) -> None:
    assert "see: plr ca init" in shell("list", code=2)
    assert "see: plr ca init" in shell("issue", "robot-1", "--role", "robot", code=2)
    shell("init", "--no-passphrase", "--days", "10")
    assert "already holds a CA" in shell("init", code=2)
    assert "the CA's certificate expires" in shell("issue", "robot-1", "--role", "robot", code=1)
    assert "plr ca list shows" in shell("renew", "robot-1", "--days", "1", code=1)
    shell("issue", "robot-1", "--role", "robot", "--days", "1")
    assert "plr ca renew robot-1" in shell("issue", "robot-1", "--role", "cloud", "--days", "1", code=1)
    other = str(tmp_path / "plr-ca/nodes/robot-1")
    assert "another --out" in shell("issue", "robot-2", "--role", "robot", "--days", "1", "--out", other, code=1)
    shell("revoke", "robot-1")
    assert "no certificate in force" in shell("revoke", "robot-1", code=1)


def test_a_folder_that_can_not_be_written_is_one_line(shell: Shell, tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    assert "file" in shell("init", "--no-passphrase", "--dir", str(tmp_path / "file" / "ca"), code=1)


@pytest.mark.parametrize(
    ("arguments", "problem"),
    [
        ([], "required"),
        (["issue", "robot-1"], "--role"),
        (["issue", "robot-1", "--role", "admin"], "invalid choice"),
        (["issue", "robot 1", "--role", "robot"], "is not a name of 1 to 63"),
        (["issue", "../x", "--role", "robot"], "is not a name of 1 to 63"),
        (["issue", ".robot", "--role", "robot"], "a letter or digit first"),
        (["issue", "robot-1", "--role", "robot", "--days", "0"], "a number of days"),
        (["issue", "robot-1", "--role", "robot", "--days", "nan"], "a number of days"),
        (["revoke", "robot-1", "--reason", "because"], "invalid choice"),
        (["init", "--name", "n" * 65], "1 to 64 bytes"),
        (["init", "--name", "ä" * 33], "1 to 64 bytes"),
        (["init", "--name", "a\nb"], "not printable"),
    ],
)
def test_bad_usage_is_told(shell: Shell, arguments: list[str], problem: str) -> None:
    assert problem in shell.usage(*arguments)


@pytest.mark.parametrize(
    "command", ["init", "issue", "sign", "renew", "revoke", "publish", "list", "rotate", "retire", "passphrase"]
)
def test_every_command_has_help(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as caught:
        __main__.main(["ca", command, "--help"])
    assert caught.value.code == 0
    assert "--dir" in capsys.readouterr().out


def test_the_commands_of_the_page_work_in_their_order(
    shell: Shell, monkeypatch: pytest.MonkeyPatch, cheap_guesses: None
) -> None:
    page = Path(__file__).parents[4] / "docs" / "start" / "certificates.md"
    commands = [
        command.split() for command in re.findall(r"^ *plr (.*)$", page.read_text(encoding="utf-8"), re.MULTILINE)
    ]
    assert {name for program, name, *_ in commands if program == "ca"} == {
        *("init", "issue", "list", "passphrase", "publish", "renew", "revoke", "rotate", "retire", "sign")
    }
    for variable in (VARIABLE, NEW_VARIABLE):
        monkeypatch.setenv(variable, "correct horse")
    for command in commands:
        shell.run(*command)
        if command[0] == "request":
            shutil.copy("plr-request/request.pem", ".")  # by scp
