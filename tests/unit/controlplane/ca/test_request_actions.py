"""`plr request` and `plr ca sign`: the key stays on its node, and the operator says who it is."""

from __future__ import annotations

import shutil
import stat
from typing import TYPE_CHECKING

import pytest

from plr.controlplane.ca.certificates import generate_key
from plr.controlplane.ca.folder import AuthorityFolder
from plr.controlplane.ca.key_file import clear_pem
from plr.controlplane.ca.request import MAX_CERTIFICATE_REQUEST_BYTES, build_request
from plr.protos.program.tls_files import load_tls_files
from plr.protos.trust.identity import IdentityRole
from tests.unit.controlplane.ca.shell import at_a_terminal

if TYPE_CHECKING:
    from pathlib import Path

    from tests.unit.controlplane.ca.shell import Shell

pytestmark = pytest.mark.audit("sec-11")

ROBOT = ("--name", "robot-1", "--role", "robot")


@pytest.fixture
def ca(shell: Shell, tmp_path: Path) -> Path:
    """A CA in the shell's folder."""
    shell("init", "--no-passphrase")
    return tmp_path / "plr-ca"


def asked(shell: Shell, out: str = "node", name: str = "robot-1", role: str = "robot", *more: str) -> str:
    """Make a request on a node; returns where it is."""
    shell.run("request", name, "--role", role, "--out", out, *more)
    return f"{out}/request.pem"


def issued(ca: Path) -> int:
    """How many certificates the CA has issued."""
    return len(AuthorityFolder(ca).records()[0].entries)


@pytest.mark.parametrize("role", [role.value for role in IdentityRole])
def test_with_what_comes_back_a_nodes_folder_is_a_tls_dir(shell: Shell, tmp_path: Path, ca: Path, role: str) -> None:
    request = asked(shell, role=role)
    key = (tmp_path / "node/key.pem").read_bytes()
    assert stat.S_IMODE((tmp_path / "node/key.pem").stat().st_mode) == 0o600
    assert stat.S_IMODE((tmp_path / "node").stat().st_mode) == 0o700
    shell("sign", request, "--name", "robot-1", "--role", role)
    answer = ca / "nodes/robot-1"
    assert sorted(path.name for path in answer.iterdir()) == ["ca.pem", "cert.pem", "crl.pem"]
    shutil.copytree(answer, tmp_path / "node", dirs_exist_ok=True)
    identity = load_tls_files(tmp_path / "node").identity
    assert (identity.name, identity.role.value) == ("robot-1", role)
    assert (tmp_path / "node/key.pem").read_bytes() == key
    found = [path for path in ca.rglob("*") if path.is_file() and key.split(b"\n")[1] in path.read_bytes()]
    assert not found


def test_a_key_is_not_overwritten(shell: Shell, tmp_path: Path) -> None:
    asked(shell)
    key = (tmp_path / "node/key.pem").read_bytes()
    again = shell.run("request", "robot-1", "--role", "robot", "--out", "node", code=1)
    assert "holds a key" in again
    asked(shell, "node", "robot-1", "robot", "--keep-key")
    assert (tmp_path / "node/key.pem").read_bytes() == key


def test_only_a_key_that_can_be_certified_is_kept(shell: Shell) -> None:
    assert "cannot be read" in shell.run("request", "robot-1", "--role", "robot", "--keep-key", code=2)


# -- the operator decides ------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "code", "problem"),
    [
        ((), 2, "asks for the name robot-1 and the role operator, and there is no terminal"),
        (("--name", "robot-1"), 2, "give --name and --role"),
        (("--role", "operator"), 2, "give --name and --role"),
        (ROBOT, 1, "asks for the role operator, not robot; nothing was signed"),
        (("--name", "robot-2", "--role", "operator"), 1, "asks for the name robot-1, not robot-2; nothing was signed"),
        (("--name", "robot-1", "--role", "operator", "--fingerprint", "SHA256:x"), 1, "asks for the key SHA256:"),
    ],
)
def test_a_robot_that_asks_to_be_an_operator_is_none_until_the_operator_says_so(
    shell: Shell, ca: Path, options: tuple[str, ...], code: int, problem: str
) -> None:
    request = asked(shell, role="operator")
    assert problem in shell("sign", request, *options, code=code)
    assert issued(ca) == 0
    assert not (ca / "nodes").exists()


def test_the_fingerprint_that_the_node_shows_can_be_demanded(shell: Shell, ca: Path) -> None:
    shown = shell.run("request", "robot-1", "--role", "robot", "--out", "node")
    other = shell.run("request", "robot-1", "--role", "robot", "--out", "attacker")
    right, wrong = (next(word for word in text.split() if word.startswith("SHA256:")) for text in (shown, other))
    assert "asks for the key" in shell("sign", "node/request.pem", *ROBOT, "--fingerprint", wrong, code=1)
    shell("sign", "node/request.pem", *ROBOT, "--fingerprint", right)
    assert issued(ca) == 1


@pytest.mark.parametrize(("typed", "code"), [("operator", 0), ("", 1), ("y", 1), ("robot", 1)])
def test_at_a_terminal_the_operator_sees_it_and_types_the_role(
    shell: Shell, tmp_path: Path, ca: Path, typed: str, code: int
) -> None:
    request = asked(shell, role="operator")
    result, said, _ = at_a_terminal(tmp_path, f"{typed}\n", "sign", request)
    assert result == code, said
    assert "robot-1, which has no certificate yet" in said
    assert "operator, which may ask the control plane about every node" in said
    assert "SHA256:" in said
    assert issued(ca) == (1 if code == 0 else 0)


def test_at_a_terminal_the_operator_sees_what_a_name_has_already(shell: Shell, tmp_path: Path, ca: Path) -> None:
    request = asked(shell)
    shell("issue", "robot-1", "--role", "robot")
    assert "a certificate as robot until" in at_a_terminal(tmp_path, "no\n", "sign", request)[1]
    shell("revoke", "robot-1")
    assert "a certificate as robot that was revoked on" in at_a_terminal(tmp_path, "no\n", "sign", request)[1]


# -- names and keys that the CA knows ------------------------------------------------------------------------------


def test_a_certificate_is_renewed_with_or_without_another_key(shell: Shell, tmp_path: Path, ca: Path) -> None:
    request = asked(shell)
    assert "plr ca list shows" in shell("sign", request, *ROBOT, "--renew", code=1)
    shell("sign", request, *ROBOT, "--days", "1")
    first = (ca / "nodes/robot-1/cert.pem").read_bytes()
    assert "robot-1 has a certificate; do: plr ca sign --renew" in shell("sign", request, *ROBOT, code=1)
    shell("sign", request, *ROBOT, "--renew")
    shell("sign", asked(shell, "next"), *ROBOT, "--renew")
    assert issued(ca) == 3
    shutil.copytree(ca / "nodes/robot-1", tmp_path / "next", dirs_exist_ok=True)
    assert load_tls_files(tmp_path / "next").certificate_pem != first


def test_renewing_changes_no_role(shell: Shell, ca: Path) -> None:
    shell("sign", asked(shell), *ROBOT)
    operator = asked(shell, "next", "robot-1", "operator")
    error = shell("sign", operator, "--name", "robot-1", "--role", "operator", "--renew", code=1)
    assert "robot-1 has the role robot, not operator" in error
    assert issued(ca) == 1


def test_a_key_serves_one_node_only(shell: Shell, tmp_path: Path, ca: Path) -> None:
    """Two robots from one disk image."""
    shell("sign", asked(shell), *ROBOT)
    shutil.copytree(tmp_path / "node", tmp_path / "copy")
    request = asked(shell, "copy", "robot-2", "robot", "--keep-key")
    error = shell("sign", request, "--name", "robot-2", "--role", "robot", code=1)
    assert "the request's key belongs to robot-1" in error


def test_a_stolen_key_does_not_come_back(shell: Shell, ca: Path) -> None:
    request = asked(shell)
    shell("sign", request, *ROBOT)
    shell("revoke", "robot-1", "--reason", "keyCompromise")
    assert "robot-1 is revoked" in shell("sign", asked(shell, "next"), *ROBOT, "--renew", code=1)
    for options in ((), ("--renew",)):
        assert "key was revoked" in shell("sign", request, *ROBOT, *options, code=1)
    shell("sign", "next/request.pem", *ROBOT)


def test_a_key_that_lies_beside_the_ca_is_not_mixed_with_a_signed_request(shell: Shell, ca: Path) -> None:
    shell("issue", "robot-1", "--role", "robot")
    assert "holds a key" in shell("sign", asked(shell), *ROBOT, "--renew", code=1)
    shell("sign", "node/request.pem", *ROBOT, "--renew", "--out", "elsewhere")
    other = asked(shell, "other", "robot-2")
    taken = shell("sign", other, "--name", "robot-2", "--role", "robot", "--out", "elsewhere", code=1)
    assert "another node's" in taken
    assert issued(ca) == 2


# -- hostile files -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("content", "problem"),
    [
        (b"", "malformed"),
        (b"\x1b[2J" * 10, "malformed"),
        (b"x" * (MAX_CERTIFICATE_REQUEST_BYTES + 1), "longer than"),
        (clear_pem(generate_key()), "malformed"),
        (build_request("robot-1", IdentityRole.ROBOT, generate_key())[:-60], "malformed"),
    ],
)
def test_a_file_that_is_no_request_is_one_line(
    shell: Shell, tmp_path: Path, ca: Path, content: bytes, problem: str
) -> None:
    (tmp_path / "request.pem").write_bytes(content)
    error = shell("sign", "request.pem", *ROBOT, code=1)
    assert problem in error
    assert error.rstrip("\n").isprintable()
    assert error.endswith("make it with: plr request\n")
    assert issued(ca) == 0


def test_an_endless_file_is_not_read_to_its_end(shell: Shell, ca: Path) -> None:
    assert "it is not a regular file" in shell("sign", "/dev/zero", *ROBOT, code=1)


def test_no_ca_and_no_file_are_told(shell: Shell, ca: Path) -> None:
    assert "No such file" in shell("sign", "nothing.pem", *ROBOT, code=1)
    request = asked(shell)
    assert "see: plr ca init" in shell("sign", request, *ROBOT, "--dir", "nowhere", code=2)


def test_the_name_of_a_file_reaches_a_terminal_without_control_characters(
    shell: Shell, tmp_path: Path, ca: Path
) -> None:
    hostile = "\x1b[2Jrequest.pem"
    shutil.copy(asked(shell), hostile)
    assert "\\x1b[2Jrequest.pem: asks for" in shell("sign", hostile, code=2)
    said = at_a_terminal(tmp_path, "no\n", "sign", hostile)[1]
    assert "\\x1b[2Jrequest.pem asks for" in said
    assert "\x1b" not in said
