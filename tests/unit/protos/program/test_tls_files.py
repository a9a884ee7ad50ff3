"""A node's folder of TLS files: refused with a line that tells what to do, and loaded again when it changes."""

from __future__ import annotations

import errno
import logging
from typing import TYPE_CHECKING, NoReturn

import pytest
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.serialization import BestAvailableEncryption, Encoding, NoEncryption, PrivateFormat

from plr.controlplane.ca import Authority
from plr.controlplane.ca.files import write_tls_files
from plr.protos.base.errors import ConfigError
from plr.protos.model.ids import NodeName
from plr.protos.program.tls_files import MAX_TLS_FILE_BYTES, RefusedFiles, TlsWatch, load_tls_files
from plr.protos.trust.identity import CertificateError, IdentityRole

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path


@pytest.fixture
def ca() -> Authority:
    return Authority.create()


@pytest.fixture
def folder(tmp_path: Path, ca: Authority) -> Path:
    ca.write_tls_dir(tmp_path / "robot-1", "robot-1", IdentityRole.ROBOT)
    return tmp_path / "robot-1"


def test_the_folder_that_the_ca_writes_is_an_identity(folder: Path, ca: Authority) -> None:
    files = load_tls_files(folder)
    assert (files.identity.name, files.identity.role) == ("robot-1", IdentityRole.ROBOT)
    assert files.ca_pem == ca.ca_pem
    assert files.trust.check(files.certificate_der, ca.entries[0].not_before).name == "robot-1"
    assert "PRIVATE" not in repr(files)


def test_the_revocation_list_may_be_missing(folder: Path) -> None:
    (folder / "crl.pem").unlink()
    assert load_tls_files(folder).crl_pem is None


def pkcs8(key: ec.EllipticCurvePrivateKey, passphrase: bytes | None = None) -> bytes:
    encryption = BestAvailableEncryption(passphrase) if passphrase else NoEncryption()
    return key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, encryption)


def other_ca() -> Authority:
    return Authority.create("other")


Breakage = tuple[str, "Callable[[Path], object]", str]
BREAKAGES: list[Breakage] = [
    ("key.pem", lambda path: path.unlink(), "there is no such file; copy the one of plr ca issue"),
    ("key.pem", lambda path: path.chmod(0o604), "others may read or change it; do: chmod 600 "),
    ("key.pem", lambda path: path.chmod(0o641), "others may read or change it; do: chmod 640 "),
    ("key.pem", lambda path: path.chmod(0o602), "others may read or change it; do: chmod 600 "),
    ("key.pem", lambda path: path.chmod(0o660), "others may read or change it; do: chmod 640 "),
    ("key.pem", lambda path: path.write_bytes(b"nothing"), "expected a private key in PEM"),
    (
        "key.pem",
        lambda path: path.write_bytes(pkcs8(ec.generate_private_key(ec.SECP256R1()), b"secret")),
        "expected a key without a passphrase",
    ),
    (
        "key.pem",
        lambda path: path.write_bytes(pkcs8(ec.generate_private_key(ec.SECP256R1()))),
        "expected the key of cert.pem",
    ),
    ("cert.pem", lambda path: path.chmod(0o646), "everybody may change it; do: chmod 644 "),
    ("cert.pem", lambda path: path.unlink(), "there is no such file"),
    ("cert.pem", lambda path: path.write_bytes(b""), "expected one certificate in PEM"),
    ("cert.pem", lambda path: path.write_bytes(path.read_bytes() * 2), "expected one certificate in PEM"),
    ("cert.pem", lambda path: path.write_bytes(bytes(MAX_TLS_FILE_BYTES + 1)), "expected at most"),
    (
        "cert.pem",
        lambda path: path.write_bytes(other_ca().issue("robot-1", IdentityRole.ROBOT).certificate_pem),
        "by another CA; issue one with the CA of ca.pem",
    ),
    ("ca.pem", lambda path: path.unlink(), "there is no such file"),
    ("ca.pem", lambda path: path.chmod(0o666), "everybody may change it"),
    ("ca.pem", lambda path: path.write_bytes(b""), "copy the ca.pem of the CA's folder there"),
    ("crl.pem", lambda path: path.chmod(0o666), "everybody may change it"),
    ("crl.pem", lambda path: path.write_bytes(b""), "copy the crl.pem of the CA's folder there"),
    ("crl.pem", lambda path: path.write_bytes(other_ca().crl_pem()), "by another CA; copy the crl.pem"),
    ("", lambda path: path.chmod(0o777), "everybody may change it; do: chmod 775 "),
    # Such as /tmp, which has to stay as it is.
    ("", lambda path: path.chmod(0o1777), "everybody may write there; copy what plr ca issue wrote to a folder of its"),
    ("", lambda path: path.rename(path.with_name("elsewhere")), "expected a folder with cert.pem, key.pem and ca.pem"),
]


@pytest.mark.parametrize(("file", "breakage", "problem"), BREAKAGES, ids=map(str, range(len(BREAKAGES))))
def test_a_folder_that_is_not_in_order_is_refused(
    folder: Path, file: str, breakage: Callable[[Path], object], problem: str
) -> None:
    path = folder / file if file else folder
    breakage(path)
    with pytest.raises(ConfigError) as caught:
        load_tls_files(folder)
    assert str(caught.value).startswith(f"{path}: ")
    assert problem in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("mode", [0o400, 0o600, 0o440, 0o640])
def test_owner_and_group_may_read_the_key(folder: Path, mode: int) -> None:
    (folder / "key.pem").chmod(mode)
    load_tls_files(folder)


@pytest.mark.audit("ops-3")
def test_a_byte_order_mark_does_not_reach_grpc(folder: Path) -> None:
    plain = load_tls_files(folder)
    for name in ("cert.pem", "key.pem", "ca.pem", "crl.pem"):
        path = folder / name
        if path.exists():
            path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes())
    read = load_tls_files(folder)
    assert (read.certificate_pem, read.key_pem, read.ca_pem) == (plain.certificate_pem, plain.key_pem, plain.ca_pem)


def test_an_expired_or_revoked_node_can_read_its_files_still(tmp_path: Path) -> None:
    ca = Authority.create(clock=lambda: 1_000_000_000.0)
    issued = ca.issue("robot-1", IdentityRole.ROBOT)
    ca.revoke("robot-1")
    write_tls_files(tmp_path, issued, ca.ca_pem, ca.crl_pem())
    assert load_tls_files(tmp_path).identity.name == "robot-1"


# -- watching ------------------------------------------------------------------------------------------------------


def test_no_change_is_no_news(folder: Path) -> None:
    watch = TlsWatch(load_tls_files(folder))
    assert [watch.poll() for _ in range(3)] == [None] * 3


def test_a_renewed_certificate_is_loaded(folder: Path, ca: Authority) -> None:
    watch = TlsWatch(load_tls_files(folder))
    issued = ca.renew("robot-1")
    write_tls_files(folder, issued, ca.ca_pem, ca.crl_pem())
    new = watch.poll()
    assert new is not None
    assert new.certificate_der == issued.certificate_der
    assert watch.current is new
    assert watch.poll() is None


def test_a_change_before_the_first_look_is_seen(folder: Path, ca: Authority) -> None:
    files = load_tls_files(folder)
    ca.revoke("robot-1")
    (folder / "crl.pem").write_bytes(ca.crl_pem())
    new = TlsWatch(files).poll()
    assert new is not None
    assert new.crl_pem != files.crl_pem


def test_files_written_again_with_the_same_content_are_no_news(folder: Path) -> None:
    watch = TlsWatch(load_tls_files(folder))
    watch.poll()
    (folder / "cert.pem").write_bytes((folder / "cert.pem").read_bytes())
    assert watch.poll() is None


def test_broken_files_keep_the_old_ones_and_are_logged_once(
    folder: Path, ca: Authority, caplog: pytest.LogCaptureFixture
) -> None:
    files = load_tls_files(folder)
    watch = TlsWatch(files)
    issued = ca.renew("robot-1")
    (folder / "cert.pem").write_bytes(issued.certificate_pem)
    with caplog.at_level(logging.ERROR):
        assert watch.poll() is None
        assert not caplog.records, "the key may be on its way"
        assert [watch.poll() for _ in range(5)] == [None] * 5
    assert len(caplog.records) == 1
    assert "expected the key of cert.pem" in caplog.text
    assert "and the next start fails" in caplog.text
    assert watch.current is files
    assert watch.refused is not None
    assert (str(folder / "key.pem") in watch.refused.why, watch.refused.start) == (True, False)

    (folder / "key.pem").write_bytes(issued.key_pem)
    assert watch.poll() is not None
    assert refused_by(watch) is None


@pytest.mark.audit("ops-14")
@pytest.mark.parametrize(
    ("name", "role", "starts"),
    [
        ("robot-2", IdentityRole.ROBOT, True),
        ("edge-1", IdentityRole.CLOUD, True),
        ("control", IdentityRole.CONTROL_PLANE, False),
    ],
)
def test_a_running_program_becomes_no_other_node(
    folder: Path, ca: Authority, caplog: pytest.LogCaptureFixture, name: str, role: IdentityRole, starts: bool
) -> None:
    files = load_tls_files(folder)
    watch = TlsWatch(files)
    write_tls_files(folder, ca.issue(NodeName(name), role), ca.ca_pem, ca.crl_pem())
    assert [watch.poll() for _ in range(3)] == [None] * 3
    assert watch.current is files
    assert watch.refused is not None
    assert f"expected the certificate of robot-1, robot, got that of {name}, {role.value}; " in watch.refused.why
    assert watch.refused.start is starts
    assert "copy the files of robot-1 there" in caplog.text
    write_tls_files(folder, ca.renew("robot-1"), ca.ca_pem, ca.crl_pem())
    assert watch.poll() is not None
    assert refused_by(watch) is None


@pytest.mark.audit("ops-14")
def test_a_control_plane_may_get_another_name(tmp_path: Path, ca: Authority) -> None:
    ca.write_tls_dir(tmp_path / "tls", "control", IdentityRole.CONTROL_PLANE)
    watch = TlsWatch(load_tls_files(tmp_path / "tls"))
    write_tls_files(tmp_path / "tls", ca.issue(NodeName("cp"), IdentityRole.CONTROL_PLANE), ca.ca_pem, ca.crl_pem())
    taken = watch.poll()
    assert taken is not None
    assert taken.identity.name == "cp"


def refused_by(watch: TlsWatch) -> RefusedFiles | None:
    """What it refuses by now."""
    return watch.refused


@pytest.mark.audit("ops-14")
def test_the_same_files_put_back_are_refused_no_more(folder: Path, caplog: pytest.LogCaptureFixture) -> None:
    watch = TlsWatch(load_tls_files(folder))
    content = (folder / "ca.pem").read_bytes()
    (folder / "ca.pem").write_bytes(b"")
    assert (watch.poll(), refused_by(watch)) == (None, None), "they may be on their way"
    assert watch.poll() is None
    assert refused_by(watch) is not None
    with caplog.at_level(logging.INFO):
        (folder / "ca.pem").write_bytes(content)
        assert watch.poll() is None
    assert refused_by(watch) is None
    assert "are valid again" in caplog.text


@pytest.mark.audit("ops-14")
def test_a_folder_that_everybody_may_write_is_noticed_and_so_is_its_mending(folder: Path) -> None:
    watch = TlsWatch(load_tls_files(folder))
    watch.poll()
    mode = folder.stat().st_mode
    folder.chmod(0o777)
    assert [watch.poll(), watch.poll()] == [None, None]
    assert refused_by(watch) is not None
    folder.chmod(mode)
    watch.poll()
    assert refused_by(watch) is None


def test_files_replaced_one_by_one_are_not_logged(
    folder: Path, ca: Authority, caplog: pytest.LogCaptureFixture
) -> None:
    watch = TlsWatch(load_tls_files(folder))
    issued = ca.renew("robot-1")
    (folder / "cert.pem").write_bytes(issued.certificate_pem)
    assert watch.poll() is None
    (folder / "key.pem").write_bytes(issued.key_pem)
    assert watch.poll() is not None
    assert not caplog.records


def test_permissions_set_right_are_noticed(folder: Path, ca: Authority) -> None:
    watch = TlsWatch(load_tls_files(folder))
    key = folder / "key.pem"
    write_tls_files(folder, ca.renew("robot-1"), ca.ca_pem, ca.crl_pem())
    key.chmod(0o644)
    assert [watch.poll() for _ in range(3)] == [None] * 3
    key.chmod(0o600)
    assert watch.poll() is not None


def test_a_folder_that_vanishes_keeps_the_old_files(folder: Path) -> None:
    files = load_tls_files(folder)
    watch = TlsWatch(files)
    folder.rename(folder.with_name("elsewhere"))
    assert [watch.poll() for _ in range(3)] == [None] * 3
    assert watch.current is files


@pytest.mark.parametrize("call", ["is_dir", "stat", "exists"])
def test_a_folder_out_of_reach_keeps_the_old_files(folder: Path, monkeypatch: pytest.MonkeyPatch, call: str) -> None:
    """As when a folder above it may not be entered: root enters it all the same, so the system's answer is made up."""

    def denied(path: Path, **_: object) -> NoReturn:
        raise PermissionError(errno.EACCES, "Permission denied", str(path))

    files = load_tls_files(folder)
    watch = TlsWatch(files)
    monkeypatch.setattr(type(folder), call, denied)
    with pytest.raises(ConfigError, match=f"{folder}.*: cannot be read: Permission denied"):
        load_tls_files(folder)
    assert [watch.poll() for _ in range(3)] == [None] * 3
    assert watch.current is files


def test_an_old_or_missing_revocation_list_does_not_replace_a_newer_one(
    folder: Path, ca: Authority, caplog: pytest.LogCaptureFixture
) -> None:
    path = folder / "crl.pem"
    old = path.read_bytes()
    ca.issue("robot-2", IdentityRole.ROBOT)
    ca.revoke("robot-2")
    path.write_bytes(ca.crl_pem())
    watch = TlsWatch(load_tls_files(folder))
    for change in (lambda: path.write_bytes(old), path.unlink):
        change()
        assert [watch.poll() for _ in range(3)] == [None] * 3
    assert [record.message.partition("crl.pem: ")[2][:20] for record in caplog.records] == [
        "missing or older than"[:20]
    ] * 2
    refused = refused_by(watch)
    assert refused is not None
    assert refused.start, "only who runs has seen the newer one"
    path.write_bytes(ca.crl_pem())
    assert watch.poll() is None, "what is in use already"
    assert refused_by(watch) is None
    assert len(caplog.records) == 2
    ca.issue("robot-3", IdentityRole.ROBOT)
    ca.revoke("robot-3")
    path.write_bytes(ca.crl_pem())
    assert watch.poll() is not None


def test_a_relayed_revocation_list_counts_beside_the_folders(folder: Path, ca: Authority) -> None:
    old = ca.crl_pem()
    robber = ca.issue("robot-2", IdentityRole.ROBOT)
    (folder / "crl.pem").unlink()
    watch = TlsWatch(load_tls_files(folder))
    now = ca.entries[0].not_before + 400.0
    assert watch.take_revocations(old)
    assert watch.current.trust.check(robber.certificate_der, now).name == "robot-2"
    ca.revoke("robot-2")
    assert watch.take_revocations(ca.crl_pem())
    for again in (ca.crl_pem(), old):
        assert not watch.take_revocations(again)
    # Also after the node's own files have changed.
    (folder / "cert.pem").write_bytes(ca.renew("robot-1").certificate_pem)
    write_tls_files(folder, ca.renew("robot-1"), ca.ca_pem, old)
    assert watch.poll() is not None
    with pytest.raises(CertificateError, match="revoked"):
        watch.current.trust.check(robber.certificate_der, now)


def test_what_was_relayed_before_is_not_lost_with_what_is_relayed_now(folder: Path, ca: Authority) -> None:
    """A peer may hold a newer list of one CA and an older one of another."""
    ca.rotate("second")
    second = Authority(ca.own, clock=ca._clock)
    (old,) = ca.former
    lists = {number: authority_pem for number, authority_pem in enumerate([old.crl_pem(), second.crl_pem()])}
    old.crl_number += 5
    (folder / "ca.pem").write_bytes(ca.ca_pem)
    watch = TlsWatch(load_tls_files(folder))
    assert watch.take_revocations(old.crl_pem())
    second.crl_number += 3
    assert watch.take_revocations(lists[0] + second.crl_pem())
    assert sorted(one.number for one in watch.current.trust.lists().values() if one) == [3, 5]
    assert not watch.take_revocations(lists[1])
    assert TlsWatch(load_tls_files(folder)).take_revocations(watch.current.trust.crl_pem())


def test_a_relayed_list_that_our_cas_did_not_sign_changes_nothing(folder: Path) -> None:
    watch = TlsWatch(load_tls_files(folder))
    other = other_ca()
    other.issue("robot-1", IdentityRole.ROBOT)
    other.revoke("robot-1")
    for crl in (other.crl_pem(), b"junk", b""):
        with pytest.raises(CertificateError):
            watch.take_revocations(crl)
    (folder / "crl.pem").unlink()
    watch = TlsWatch(load_tls_files(folder))
    for crl in (other.crl_pem(), b"junk", b""):
        with pytest.raises(CertificateError):
            watch.take_revocations(crl)
    own = watch.current.identity
    assert watch.current.trust.check(watch.current.certificate_der, own.not_before) == own
