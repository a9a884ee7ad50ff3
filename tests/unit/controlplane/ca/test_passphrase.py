"""The passphrase of the CA's key on the command line: asked for unless given or refused, and never waited for."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest
from cryptography.hazmat.primitives.serialization import BestAvailableEncryption, Encoding, PrivateFormat

from plr.controlplane.ca.folder import AuthorityFolder, Protection
from plr.protos.program.tls_files import load_private_key
from tests.unit.controlplane.ca.shell import at_a_terminal

if TYPE_CHECKING:
    from pathlib import Path

    from tests.unit.controlplane.ca.shell import Shell

pytestmark = pytest.mark.audit("sec-11")

PASSPHRASE = "correct horse"


def secret(path: Path, text: str = PASSPHRASE) -> str:
    path.write_text(f"{text}\n")
    path.chmod(0o600)
    return str(path)


def protections(tmp_path: Path) -> list[Protection]:
    return AuthorityFolder(tmp_path / "plr-ca").protections()


def test_without_a_word_on_it_no_ca_is_made_where_nobody_can_be_asked(shell: Shell, tmp_path: Path) -> None:
    error = shell("init", code=2)
    for way in ("--passphrase-file", "PLR_CA_PASSPHRASE", "--no-passphrase"):
        assert way in error
    assert not (tmp_path / "plr-ca").exists()


def test_a_passphrase_in_a_file_is_needed_by_every_command_that_signs(
    shell: Shell, tmp_path: Path, cheap_guesses: None
) -> None:
    file = tmp_path / "passphrase"
    option = ["--passphrase-file", secret(file)]
    assert "its key is encrypted" in shell("init", *option)
    assert protections(tmp_path) == [Protection.GOOD]
    error = shell("issue", "robot-1", "--role", "robot", code=2)
    assert "--passphrase-file" in error
    assert "PLR_CA_PASSPHRASE" in error
    shell("issue", "robot-1", "--role", "robot", *option)
    assert not shell.warnings
    assert "robot-1" in shell("list")
    secret(file, "wrong")
    assert "another passphrase" in shell("renew", "robot-1", *option, code=2)
    secret(file, "")
    assert "expected a passphrase" in shell("renew", "robot-1", *option, code=2)
    file.chmod(0o644)
    assert "others may read" in shell("renew", "robot-1", *option, code=2)


def test_a_passphrase_may_stand_in_the_environment(
    shell: Shell, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, cheap_guesses: None
) -> None:
    monkeypatch.setenv("PLR_CA_PASSPHRASE", PASSPHRASE)
    shell("init")
    assert protections(tmp_path) == [Protection.GOOD]
    shell("issue", "robot-1", "--role", "robot")
    monkeypatch.setenv("PLR_CA_PASSPHRASE", "wrong")
    assert "another passphrase" in shell("renew", "robot-1", code=2)
    shell("renew", "robot-1", "--passphrase-file", secret(tmp_path / "passphrase"))
    monkeypatch.setenv("PLR_CA_PASSPHRASE", "")
    assert "expected a passphrase" in shell("renew", "robot-1", code=2)


@pytest.mark.parametrize("text", ["", "1234567", "x" * 1024, "two\nlines"])
def test_a_passphrase_that_protects_nothing_is_refused(shell: Shell, tmp_path: Path, text: str) -> None:
    assert "expected a passphrase" in shell("init", "--passphrase-file", secret(tmp_path / "passphrase", text), code=2)
    assert not (tmp_path / "plr-ca").exists()


def test_a_key_in_clear_is_warned_of_until_it_is_encrypted(
    shell: Shell, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, cheap_guesses: None
) -> None:
    assert "its key is not encrypted" in shell("init", "--no-passphrase")
    shell("issue", "robot-1", "--role", "robot")
    (warning,) = shell.warnings
    assert warning.endswith("the CA's key is not encrypted; do: plr ca passphrase --dir plr-ca\n")
    file = secret(tmp_path / "passphrase")
    assert "leave out --passphrase-file" in shell("renew", "robot-1", "--passphrase-file", file, code=2)
    assert "--new-passphrase-file" in shell("passphrase", code=2)
    assert "encrypted with the new passphrase" in shell("passphrase", "--new-passphrase-file", file)
    assert protections(tmp_path) == [Protection.GOOD]
    monkeypatch.setenv("PLR_CA_PASSPHRASE", PASSPHRASE)
    shell("renew", "robot-1")
    assert not shell.warnings


def test_a_key_as_it_was_encrypted_before_still_opens(
    shell: Shell, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, cheap_guesses: None
) -> None:
    shell("init", "--no-passphrase")
    (path,) = tmp_path.glob("plr-ca/authorities/*/key.pem")
    key = load_private_key(path.read_bytes(), None, path)
    old = BestAvailableEncryption(PASSPHRASE.encode())
    path.write_bytes(key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, old))
    assert protections(tmp_path) == [Protection.WEAK]
    monkeypatch.setenv("PLR_CA_PASSPHRASE", PASSPHRASE)
    shell("issue", "robot-1", "--role", "robot")
    (warning,) = shell.warnings
    assert warning.endswith("encrypted by an old, weak method; do: plr ca passphrase --dir plr-ca\n")
    # The same passphrase will do: it is encrypted as it is today.
    monkeypatch.setenv("PLR_CA_NEW_PASSPHRASE", PASSPHRASE)
    shell("passphrase")
    assert protections(tmp_path) == [Protection.GOOD]
    shell("renew", "robot-1")
    assert not shell.warnings


def test_encryption_can_be_taken_away_by_name_only(
    shell: Shell, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, cheap_guesses: None
) -> None:
    monkeypatch.setenv("PLR_CA_PASSPHRASE", PASSPHRASE)
    shell("init")
    assert "--no-passphrase" in shell("passphrase", code=2)
    assert "no longer encrypted" in shell("passphrase", "--no-passphrase")
    assert protections(tmp_path) == [Protection.CLEAR]
    assert "not allowed with" in shell.usage("init", "--no-passphrase", "--passphrase-file", "x")


# -- at a terminal -------------------------------------------------------------------------------------------------


def test_whoever_sits_at_a_terminal_is_asked_twice_and_sees_nothing_of_it(tmp_path: Path) -> None:
    code, said, echo = at_a_terminal(tmp_path, f"{PASSPHRASE}\n{PASSPHRASE}\n", "init")
    assert (code, said.count("|")) == (0, 2), said
    assert "at least 8 characters" in said
    assert PASSPHRASE not in echo
    assert protections(tmp_path) == [Protection.GOOD]
    code, said, echo = at_a_terminal(tmp_path, f"{PASSPHRASE}\n", "issue", "robot-1", "--role", "robot")
    assert (code, said.count("|")) == (0, 1), said
    assert PASSPHRASE not in echo


def test_a_slip_of_the_fingers_makes_no_ca(tmp_path: Path) -> None:
    code, said, _ = at_a_terminal(tmp_path, f"{PASSPHRASE}\nkorrect horse\n", "init")
    assert code == 2
    assert "the two differ" in said
    assert not (tmp_path / "plr-ca").exists()


def test_a_passphrase_is_changed_at_a_terminal(tmp_path: Path) -> None:
    typed = f"{PASSPHRASE}\n"
    assert at_a_terminal(tmp_path, typed * 2, "init")[0] == 0
    code, said, _ = at_a_terminal(tmp_path, f"{typed}battery staple\nbattery staple\n", "passphrase")
    assert (code, said.count("|")) == (0, 3), said
    assert "another passphrase" in at_a_terminal(tmp_path, typed, "issue", "robot-1", "--role", "robot")[1]
    assert at_a_terminal(tmp_path, "battery staple\n", "issue", "robot-1", "--role", "robot")[0] == 0
