"""Writes files so that a reader finds the old or the new one whole, and keys so that only their owner can read them."""

from __future__ import annotations

import contextlib
import errno
import os
import stat
import tempfile
from typing import TYPE_CHECKING

from plr.protos.program.tls_files import CA_FILE, CERTIFICATE_FILE, CRL_FILE, KEY_FILE

if TYPE_CHECKING:
    from pathlib import Path

    from plr.controlplane.ca.certificates import Issued

PRIVATE_FOLDER = 0o700
PRIVATE_FILE = 0o600
PUBLIC_FILE = 0o644


def write_atomically(path: Path, data: bytes, mode: int) -> None:
    """Replace the file as a whole, with this mode, and return once it is on disk; raises OSError.

    The file gets the owner of its folder, so that root can renew what a service reads.
    """
    owner = path.parent.stat()
    descriptor, temporary = tempfile.mkstemp(prefix=f".{path.name}.", dir=path.parent)
    try:
        with os.fdopen(descriptor, "wb") as file:
            file.write(data)
            file.flush()
            if os.geteuid() == 0:
                os.fchown(file.fileno(), owner.st_uid, owner.st_gid)
            os.fchmod(file.fileno(), mode)
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except BaseException:
        with contextlib.suppress(OSError):
            os.unlink(temporary)
        raise
    folder = os.open(path.parent, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(folder)
    finally:
        os.close(folder)


def write_tls_files(folder: Path, issued: Issued, ca_pem: bytes, crl_pem: bytes) -> None:
    """Write a node's TLS files; a missing folder is made, accessible only to its owner. Raises OSError."""
    write_certificate(folder, issued.certificate_pem, ca_pem, crl_pem, issued.key_pem)


def write_certificate(
    folder: Path, certificate_pem: bytes, ca_pem: bytes, crl_pem: bytes, key_pem: bytes | None = None
) -> None:
    """Write a node's TLS files as `write_tls_files` does, without the key if only the node has it; raises OSError."""
    make_private(folder)
    write_atomically(folder / CA_FILE, ca_pem, PUBLIC_FILE)
    write_atomically(folder / CRL_FILE, crl_pem, PUBLIC_FILE)
    if key_pem is not None:
        write_atomically(folder / KEY_FILE, key_pem, PRIVATE_FILE)
    write_atomically(folder / CERTIFICATE_FILE, certificate_pem, PUBLIC_FILE)


def make_private(folder: Path) -> None:
    """Make a folder if it is missing, accessible only to its owner; raises OSError, as `refuse_planted` does."""
    folder.mkdir(mode=PRIVATE_FOLDER, parents=True, exist_ok=True)
    refuse_planted(folder)


def refuse_planted(folder: Path) -> None:
    """Raise OSError if another user made a folder for a key where everybody may create folders, as in /tmp.

    Elsewhere it may well belong to another user, such as a service.
    """
    owner = folder.stat().st_uid
    if owner not in (0, os.geteuid()) and folder.absolute().parent.stat().st_mode & stat.S_IWOTH:
        raise OSError(
            errno.EPERM,
            f"it belongs to user {owner}, in a folder where everybody may make some: name another",
            str(folder),
        )
