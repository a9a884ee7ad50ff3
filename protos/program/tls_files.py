"""Reads a node's folder of TLS files (`tls_dir`) strictly, and again when they change.

    cert.pem   the node's certificate
    key.pem    its private key; nobody but the owner may write it, nobody but owner and group may read it
    ca.pem     the CA, or several while one replaces another
    crl.pem    the CAs' revocation lists; may be missing

Both planes read their identity with it; no core does.
"""

from __future__ import annotations

import codecs
import dataclasses
import logging
import os
import stat
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from cryptography import x509
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.serialization import Encoding, load_pem_private_key

from plr.protos.base.errors import ConfigError
from plr.protos.program.regular_file import open_regular
from plr.protos.trust.identity import CertificateError, Identity, IdentityRole, Trust

if TYPE_CHECKING:
    from pathlib import Path

CERTIFICATE_FILE = "cert.pem"
KEY_FILE = "key.pem"
CA_FILE = "ca.pem"
CRL_FILE = "crl.pem"

POLL_INTERVAL_S = 0.25
"""How often to look for changes: a revocation must take effect within a second."""

MAX_TLS_FILE_BYTES = 4 << 20
"""A revocation list of some 50,000 certificates; a larger file is something else."""

KEY_FORBIDDEN = stat.S_IRWXO | stat.S_IWGRP
"""Permissions that a node's key must not have; its group may read it, so that it need not belong to the service."""

FORBIDDEN = stat.S_IWOTH
"""Permissions that everything else must not have."""

_OWNER = "; give it to the account that runs this (chown plr)"

_READABLE = stat.S_IRGRP | stat.S_IROTH

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class TlsFiles:
    """Content of a node's TLS files. To learn whether the certificate is in force now, the user asks `trust`."""

    directory: Path
    certificate_pem: bytes
    certificate_der: bytes
    key_pem: bytes = field(repr=False)
    private_key: ec.EllipticCurvePrivateKey = field(repr=False, compare=False)
    ca_pem: bytes
    crl_pem: bytes | None
    identity: Identity
    trust: Trust = field(repr=False, compare=False)


@dataclass(frozen=True, slots=True)
class RefusedFiles:
    """The current content of a folder, which a running program refuses."""

    why: str
    """One line: the file, what is wrong, what to do."""
    start: bool
    """Whether a program would start with them: it then knows neither the list in use nor whose certificate was."""


def load_tls_files(directory: Path) -> TlsFiles:
    """Return the node's TLS files; raise ConfigError with one line that says what to do."""
    try:
        return _load(directory)
    except OSError as error:
        # The folder may not be entered, or was replaced while being read.
        path = str(error.filename or directory)
        hint = _OWNER if isinstance(error, PermissionError) else ""
        raise ConfigError(path, "", f"cannot be read: {error.strerror or error}{hint}") from error


def _load(directory: Path) -> TlsFiles:
    if not directory.is_dir():
        raise ConfigError(str(directory), "", "expected a folder with cert.pem, key.pem and ca.pem; see: plr ca issue")
    _refuse_shared(directory)
    ca_path, crl_path = directory / CA_FILE, directory / CRL_FILE
    ca_pem = _read(ca_path, FORBIDDEN)
    crl_pem = _read(crl_path, FORBIDDEN) if crl_path.exists() else None
    try:
        trust = Trust(ca_pem)
    except CertificateError as error:
        raise ConfigError(str(ca_path), "", f"{error}; copy the ca.pem of the CA's folder there") from error
    if crl_pem is not None:
        try:
            trust = Trust(ca_pem, crl_pem)
        except CertificateError as error:
            raise ConfigError(str(crl_path), "", f"{error}; copy the crl.pem of the CA's folder there") from error
    return _node(directory, trust, ca_pem, crl_pem)


def _node(directory: Path, trust: Trust, ca_pem: bytes, crl_pem: bytes | None) -> TlsFiles:
    path = directory / CERTIFICATE_FILE
    certificate_pem = _read(path, FORBIDDEN)
    try:
        (certificate,) = x509.load_pem_x509_certificates(certificate_pem)
    except Exception as error:
        # Not only ValueError: for example, an unknown version raises another kind.
        raise ConfigError(str(path), "", "expected one certificate in PEM; copy the one of plr ca issue") from error
    certificate_der = certificate.public_bytes(Encoding.DER)
    try:
        identity = trust.identify(certificate_der)
    except CertificateError as error:
        raise ConfigError(str(path), "", f"{error}; issue one with the CA of {CA_FILE}: plr ca issue") from error
    key_path = directory / KEY_FILE
    key_pem = _read(key_path, KEY_FORBIDDEN)
    key = load_private_key(key_pem, None, key_path)
    if key.public_key() != certificate.public_key():
        raise ConfigError(str(key_path), "", f"expected the key of {CERTIFICATE_FILE}; copy two that belong together")
    return TlsFiles(
        directory=directory,
        certificate_pem=certificate_pem,
        certificate_der=certificate_der,
        key_pem=key_pem,
        private_key=key,
        ca_pem=ca_pem,
        crl_pem=crl_pem,
        identity=identity,
        trust=trust,
    )


def _read(path: Path, forbidden: int) -> bytes:
    """Do the same as `read_guarded`, with advice on a file that is missing or unreadable for us.

    Leave out the byte order mark that some editors put first: gRPC takes no PEM behind it, though `cryptography` does.
    """
    try:
        return read_guarded(path, forbidden).removeprefix(codecs.BOM_UTF8)
    except ConfigError as error:
        if isinstance(error.__cause__, FileNotFoundError):
            raise ConfigError(error.source, "", "there is no such file; copy the one of plr ca issue") from error
        if isinstance(error.__cause__, PermissionError):
            raise ConfigError(error.source, "", f"{error.problem}{_OWNER}") from error
        raise


def read_guarded(path: Path, forbidden: int, *, most: int = MAX_TLS_FILE_BYTES) -> bytes:
    """Return the file's content, at most `most` bytes; raise ConfigError, also for any `forbidden` permission."""
    try:
        with open_regular(path) as file:
            # Check the opened file, not whatever had the name a moment before.
            _refuse_permissions(path, os.fstat(file.fileno()), forbidden)
            data = file.read(most + 1)
    except OSError as error:
        raise ConfigError(str(path), "", f"cannot be read: {error.strerror or error}") from error
    if len(data) > most:
        raise ConfigError(str(path), "", f"expected at most {most} bytes")
    return data


def load_private_key(pem: bytes, passphrase: bytes | None, path: Path) -> ec.EllipticCurvePrivateKey:
    """Return the ECDSA key; raise a ConfigError that names `path`."""
    try:
        key = load_pem_private_key(pem, password=passphrase)
    except TypeError as error:
        problem = "a key without a passphrase" if passphrase is None else "a key with a passphrase"
        raise ConfigError(str(path), "", f"expected {problem}") from error
    except Exception as error:
        problem = "expected a private key in PEM"
        if passphrase is not None:
            problem = "the passphrase does not open it: give another passphrase, or a private key in PEM"
        raise ConfigError(str(path), "", problem) from error
    if not isinstance(key, ec.EllipticCurvePrivateKey):
        raise ConfigError(str(path), "", "expected an ECDSA key")
    return key


def _refuse_permissions(path: Path, status: os.stat_result, forbidden: int) -> None:
    mode = stat.S_IMODE(status.st_mode)
    if mode & forbidden:
        problem = "others may read or change it" if forbidden & _READABLE else "everybody may change it"
        raise ConfigError(str(path), "", f"{problem}; do: chmod {mode & ~forbidden:o} {path}")


def _refuse_shared(folder: Path) -> None:
    status = folder.stat()
    if status.st_mode & FORBIDDEN and (status.st_mode & stat.S_ISVTX or status.st_uid not in (0, os.geteuid())):
        # A folder such as /tmp, which has to stay writable for everybody.
        problem = "everybody may write there; copy what plr ca issue wrote to a folder of its own, and name that one"
        raise ConfigError(str(folder), "", problem)
    _refuse_permissions(folder, status, FORBIDDEN)


class TlsWatch:
    """Holds a node's TLS files and reloads them when they have changed on disk.

    Call `poll` every `POLL_INTERVAL_S`. If files do not fit together, the old ones stay in force. That is normal while
    they are being replaced one by one, so it is logged only if they still do not fit at the next look, and only once.
    A certificate is only replaced by one of the same node, a revocation list only by a newer one. A list from another
    source counts in addition to the folder's.
    """

    def __init__(self, files: TlsFiles) -> None:
        self.current = files
        self._relayed = b""
        # Unknown, so it differs from anything on disk: a change between loading and now is not missed.
        self._seen: _Fingerprint | None = None
        self._broken: _Fingerprint | None = None
        self.refused: RefusedFiles | None = None
        """The folder's current files, once they did not fit at two looks. Any thread may read it."""

    def poll(self) -> TlsFiles | None:
        """Look once; return the new files if they have changed and are good, else None."""
        fingerprint = _fingerprint(self.current.directory)
        if fingerprint == self._seen:
            return None
        try:
            files = self._with_relayed(load_tls_files(self.current.directory))
        except ConfigError as error:
            self._refuse(fingerprint, RefusedFiles(str(error), start=False))
            return None
        if refused := self._unlike(files):
            self._refuse(fingerprint, refused)
            return None
        if self.refused is not None:
            _log.info("the TLS files in %s are valid again", self.current.directory)
        self._seen, self._broken, self.refused = fingerprint, None, None
        changed = files != self.current
        self.current = files
        return files if changed else None

    def _unlike(self, files: TlsFiles) -> RefusedFiles | None:
        """Return what keeps good files from replacing those in use, or None."""
        was, new = self.current.identity, files.identity
        if new.role is not was.role or (new.name != was.name and was.role is not IdentityRole.CONTROL_PLANE):
            mine, other = (f"{one.name}, {one.role.value}" for one in (was, new))
            problem = f"expected the certificate of {mine}, got that of {other}; copy the files of {was.name} there"
            starts = IdentityRole.CONTROL_PLANE not in (was.role, new.role)
            return self._refused(CERTIFICATE_FILE, problem, start=starts)
        if files.trust.forgets(self.current.trust):
            problem = "missing or older than the one in use; copy the newest there"
            return self._refused(CRL_FILE, problem, start=True)
        return None

    def _refused(self, name: str, problem: str, *, start: bool) -> RefusedFiles:
        return RefusedFiles(str(ConfigError(str(self.current.directory / name), "", problem)), start=start)

    def _refuse(self, fingerprint: _Fingerprint, refused: RefusedFiles) -> None:
        if fingerprint == self._broken:
            after = "" if refused.start else ", and the next start fails"
            _log.error("new TLS files are refused; the old ones stay in use%s: %s", after, refused.why)
            self._seen, self.refused = fingerprint, refused
        self._broken = fingerprint

    def take_revocations(self, crl_pem: bytes) -> bool:
        """Add relayed lists to those in use; return whether they say anything new.

        Raises:
            CertificateError: they are malformed, or of no CA of ours.
        """
        before = self.current.trust
        trust = before.with_revocations(crl_pem)
        if not before.forgets(trust):
            return False
        self._relayed = trust.crl_pem()
        self.current = dataclasses.replace(self.current, trust=trust)
        return True

    def _with_relayed(self, files: TlsFiles) -> TlsFiles:
        if not self._relayed:
            return files
        try:
            trust = files.trust.with_revocations(self._relayed)
        except CertificateError as error:
            _log.warning("the revocation lists that were relayed are ignored: %s", error)
            return files
        return dataclasses.replace(files, trust=trust)


_Fingerprint = tuple[tuple[int, ...] | None, ...]
"""What distinguishes the folder and each file from a later one of the same name; None for a missing one."""


def _fingerprint(directory: Path) -> _Fingerprint:
    files = (_file_fingerprint(directory / name) for name in (CERTIFICATE_FILE, KEY_FILE, CA_FILE, CRL_FILE))
    return (_folder_fingerprint(directory), *files)


def _folder_fingerprint(path: Path) -> tuple[int, ...] | None:
    """Return the folder's inode, owner and permissions, but no times, which any other file in it changes."""
    try:
        status = path.stat()
    except OSError:
        return None
    return (status.st_ino, status.st_mode, status.st_uid, status.st_gid)


def _file_fingerprint(path: Path) -> tuple[int, ...] | None:
    try:
        status = path.stat()
    except OSError:
        return None
    return (status.st_ino, status.st_mtime_ns, status.st_ctime_ns, status.st_size)
