"""Keeps a CA on disk.

    index.json               the CAs, the one that issues first, and what each has issued and revoked
    authorities/SERIAL/      cert.pem and key.pem of each; the key under a passphrase, unless refused
    ca.pem, crl.pem          what every node needs, written from the above
    nodes/NAME/              a folder for each node, ready to be its `tls_dir`

Only its owner may access the folder, every file is replaced as a whole, and only one command at a time changes
anything. index.json alone is authoritative: a command interrupted before it has written that has not happened.
"""

from __future__ import annotations

import contextlib
import enum
import fcntl
import os
import re
import shutil
from typing import TYPE_CHECKING

from cryptography import x509

from plr.controlplane.ca.authority import Authority
from plr.controlplane.ca.certificates import Issued
from plr.controlplane.ca.files import PRIVATE_FILE, PRIVATE_FOLDER, PUBLIC_FILE, write_atomically
from plr.controlplane.ca.index import decode_index, encode_index
from plr.controlplane.ca.key_file import clear_pem, encrypted_pem, is_encrypted, is_well_encrypted
from plr.protos.base.errors import ConfigError
from plr.protos.program.regular_file import read_regular
from plr.protos.program.tls_files import CA_FILE, CERTIFICATE_FILE, CRL_FILE, KEY_FILE, load_private_key, read_guarded

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping
    from pathlib import Path

    from cryptography.hazmat.primitives.asymmetric import ec

    from plr.controlplane.ca.index import Record

INDEX_FILE = "index.json"
AUTHORITIES = "authorities"
NODES = "nodes"
_LOCK_FILE = ".lock"
_PEM_LIST = re.compile(rb"-----BEGIN X509 CRL-----.*?-----END X509 CRL-----", re.DOTALL)

MAX_INDEX_BYTES = 64 << 20
"""Longest index, some 200,000 certificates; a longer one is not written."""

_TEMPORARY = re.compile(r"\.(index\.json|(ca|crl|cert|key)\.pem)\.[^.]{8}")
"""Name of a file that a command leaves behind if interrupted while writing; it may hold a key."""

NOT_THE_OWNER = 0o077
"""Permissions that no file of a CA needs."""


class Protection(enum.IntEnum):
    """How well a CA's keys are protected from somebody who obtains the files, the worst first."""

    CLEAR = 0
    WEAK = 1
    """Encrypted as older versions did it: guesses at the passphrase are cheap."""
    GOOD = 2


class AuthorityFolder:
    """The folder that holds a CA; `passphrase` is for its private keys."""

    def __init__(self, path: Path, passphrase: bytes | None = None, on_wait: Callable[[], None] = lambda: None) -> None:
        """Open the folder; `on_wait` is called before waiting for another command at work here."""
        self.path = path
        self._passphrase = passphrase
        self._on_wait = on_wait

    def node_folder(self, name: str) -> Path:
        """Return the default folder for a node's files."""
        return self.path / NODES / name

    def create(self, authority: Authority) -> None:
        """Save a new CA; raises ConfigError if there is one already or the folder holds anything else, and OSError."""
        self.refuse_existing()
        self._refuse_other_things()
        self.path.mkdir(mode=PRIVATE_FOLDER, parents=True, exist_ok=True)
        self._refuse_others()
        self.path.chmod(PRIVATE_FOLDER)
        with self._lock():
            self.refuse_existing()
            self.save(authority)

    def refuse_existing(self) -> None:
        """Raise ConfigError if there is a CA already."""
        if (self.path / INDEX_FILE).exists():
            raise ConfigError(str(self.path), "", "this folder already holds a CA; another one needs another --dir")

    def _refuse_other_things(self) -> None:
        """Refuse a folder that others use: only its owner will have access to it."""
        own = {AUTHORITIES, NODES, CA_FILE, CRL_FILE, _LOCK_FILE}
        if self.path.exists() and any(
            each.name not in own and not _TEMPORARY.fullmatch(each.name) for each in self.path.iterdir()
        ):
            raise ConfigError(str(self.path), "", "holds other things; a CA needs a --dir of its own")

    def _refuse_others(self) -> None:
        """Raise ConfigError if another user made the folder, or something in it, and so could obtain the keys."""
        for path in (self.path, *self.path.iterdir()):
            _refuse_strange(path, path.stat() if path == self.path else path.lstat())

    def protections(self) -> list[Protection]:
        """Return how each of the CAs' keys is protected; raises ConfigError."""
        keys = [read_guarded(self._key_path(record), NOT_THE_OWNER) for record in self.records()]
        return [
            Protection.GOOD if is_well_encrypted(pem) else Protection.WEAK if is_encrypted(pem) else Protection.CLEAR
            for pem in keys
        ]

    def change_passphrase(self, new: bytes | None) -> None:
        """Encrypt the CAs' keys with another passphrase, or not at all; raises ConfigError, OSError.

        If interrupted, it has changed only some keys; run again, it changes the rest.
        """
        self._check()
        with self._lock():
            self._sweep()
            keys = [(path, self._open(path, new)) for path in map(self._key_path, self.records())]
            for path, key in keys:
                write_atomically(path, _key_pem(key, new), PRIVATE_FILE)

    def _open(self, path: Path, new: bytes | None) -> ec.EllipticCurvePrivateKey:
        try:
            return self._load_key(path, self._passphrase)
        except ConfigError:
            if new is None:
                raise
            with contextlib.suppress(ConfigError):
                return self._load_key(path, new)
            raise

    @contextlib.contextmanager
    def locked(self) -> Iterator[Authority]:
        """Load the CA and keep other commands from changing it meanwhile; raises ConfigError."""
        self._check()
        with self._lock():
            self._sweep()
            lists = self._lists()
            first, *former = (self._load(record) for record in self.records())
            first.former = former
            for each in (first, *former):
                each.adopt(lists)
            yield first

    def _sweep(self) -> None:
        """Delete what interrupted commands left behind."""
        for folder in (self.path, *(self.path / AUTHORITIES).glob("*"), *(self.path / NODES).glob("*")):
            with contextlib.suppress(OSError):
                for path in folder.iterdir():
                    if _TEMPORARY.fullmatch(path.name):
                        path.unlink()

    def _lists(self) -> tuple[x509.CertificateRevocationList, ...]:
        """Return the revocation lists stored here: nodes may already have those of an interrupted command."""
        try:
            pem = read_regular(self.path / CRL_FILE, MAX_INDEX_BYTES)
            return tuple(x509.load_pem_x509_crl(one) for one in _PEM_LIST.findall(pem))
        except (OSError, ValueError):
            return ()

    def records(self) -> tuple[Record, ...]:
        """Return what the CAs have done, the one that issues first; needs no passphrase. Raises ConfigError."""
        self._check()
        path = self.path / INDEX_FILE
        return decode_index(read_guarded(path, NOT_THE_OWNER, most=MAX_INDEX_BYTES), path)

    def certificate(self, record: Record) -> x509.Certificate:
        """Return the certificate of a CA that is kept here; raises ConfigError."""
        path = self._own_folder(record) / CERTIFICATE_FILE
        try:
            return x509.load_pem_x509_certificate(read_guarded(path, NOT_THE_OWNER))
        except ValueError as error:
            raise ConfigError(str(path), "", "expected a certificate in PEM") from error

    def save(self, authority: Authority) -> list[str]:
        """Save the CA; return the nodes' folders that could not be updated, and why.

        The revocation list is written before the index: after an interruption in between, the next command adopts the
        list. The other way round the certificate would count as revoked, and no node would learn of it.

        Raises:
            OSError: a file of the CA's own cannot be written.
            ConfigError: the index would be too long; nothing was written.
        """
        records = [each.record() for each in (authority, *authority.former)]
        index = encode_index(records)
        if len(index) > MAX_INDEX_BYTES:
            raise ConfigError(
                str(self.path / INDEX_FILE), "", "it is full; do: plr ca rotate, renew every node, plr ca retire"
            )
        for each, record in zip((authority, *authority.former), records, strict=True):
            self._keep_key(each, self._own_folder(record))
        current = {CA_FILE: authority.ca_pem, CRL_FILE: authority.crl_pem()}
        write_atomically(self.path / CRL_FILE, current[CRL_FILE], PUBLIC_FILE)
        write_atomically(self.path / INDEX_FILE, index, PRIVATE_FILE)
        write_atomically(self.path / CA_FILE, current[CA_FILE], PUBLIC_FILE)
        problems = self._refresh_nodes(current)
        kept = {self._own_folder(record) for record in records}
        for path in (self.path / AUTHORITIES).iterdir():
            if path not in kept:
                shutil.rmtree(path)
        return problems

    def _refresh_nodes(self, current: Mapping[str, bytes]) -> list[str]:
        """Write the current CAs and revocations into every node's folder, so that copying it again undoes nothing."""
        problems = []
        for name, data in current.items():
            for path in (self.path / NODES).glob(f"*/{name}"):
                try:
                    # A service owns its folder: it may hold anything under this name.
                    if read_regular(path, len(data) + 1) != data:
                        write_atomically(path, data, PUBLIC_FILE)
                except OSError as error:
                    problems.append(f"{path}: could not be updated: {error.strerror or error}")
        return problems

    def _keep_key(self, authority: Authority, folder: Path) -> None:
        if (folder / KEY_FILE).exists():
            return
        folder.mkdir(mode=PRIVATE_FOLDER, parents=True, exist_ok=True)
        write_atomically(folder / CERTIFICATE_FILE, authority.own.certificate_pem, PRIVATE_FILE)
        write_atomically(folder / KEY_FILE, _key_pem(authority.own.key, self._passphrase), PRIVATE_FILE)

    def _load(self, record: Record) -> Authority:
        key = self._load_key(self._key_path(record), self._passphrase)
        issued = Issued(self.certificate(record), key)
        return Authority(issued, record.entries, record.crl_number, published_at=record.published_at, past=record.past)

    def _load_key(self, path: Path, passphrase: bytes | None) -> ec.EllipticCurvePrivateKey:
        pem = read_guarded(path, NOT_THE_OWNER)
        if not is_encrypted(pem):
            return load_private_key(pem, None, path)
        if passphrase is None:
            raise ConfigError(str(path), "", "the CA's key has a passphrase; give --passphrase-file")
        return load_private_key(pem, passphrase, path)

    def _key_path(self, record: Record) -> Path:
        return self._own_folder(record) / KEY_FILE

    def _own_folder(self, record: Record) -> Path:
        return self.path / AUTHORITIES / f"{record.serial:x}"

    def _check(self) -> None:
        if not (self.path / INDEX_FILE).is_file():
            raise ConfigError(str(self.path), "", "expected the folder of a CA; see: plr ca init --help")
        status = self.path.stat()
        _refuse_strange(self.path, status)
        if status.st_mode & NOT_THE_OWNER:
            raise ConfigError(str(self.path), "", f"others may enter it; do: chmod 700 {self.path}")

    @contextlib.contextmanager
    def _lock(self) -> Iterator[None]:
        descriptor = os.open(self.path / _LOCK_FILE, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, PRIVATE_FILE)
        try:
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                self._on_wait()
                fcntl.flock(descriptor, fcntl.LOCK_EX)
            yield
        finally:
            os.close(descriptor)


def _refuse_strange(path: Path, status: os.stat_result) -> None:
    if status.st_uid not in (0, os.geteuid()):
        problem = f"belongs to user {status.st_uid}; give another --dir, or run plr as that user"
        raise ConfigError(str(path), "", problem)


def _key_pem(key: ec.EllipticCurvePrivateKey, passphrase: bytes | None) -> bytes:
    return clear_pem(key) if passphrase is None else encrypted_pem(key, passphrase)
