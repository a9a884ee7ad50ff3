"""Carries out the commands of `plr ca`; they raise AuthorityError, ConfigError or OSError, and return text to print.

Once a command returns, its work is done, whether or not the text can be printed.
"""

from __future__ import annotations

import shlex
import sys
import time
from typing import TYPE_CHECKING

from cryptography import x509
from cryptography.x509.oid import NameOID

from plr.controlplane.ca import listing
from plr.controlplane.ca.authority import Authority, AuthorityError
from plr.controlplane.ca.files import refuse_planted, write_tls_files
from plr.controlplane.ca.folder import AuthorityFolder, Protection
from plr.controlplane.ca.passphrase import NEW_VARIABLE, VARIABLE, PassphraseSource
from plr.protos.base.errors import ConfigError
from plr.protos.base.printable import escaped
from plr.protos.program.regular_file import read_regular
from plr.protos.program.tls_files import (
    CA_FILE,
    CERTIFICATE_FILE,
    CRL_FILE,
    KEY_FILE,
    KEY_FORBIDDEN,
    MAX_TLS_FILE_BYTES,
    load_private_key,
    read_guarded,
)
from plr.protos.trust.identity import IdentityRole

if TYPE_CHECKING:
    import argparse
    from pathlib import Path

    from cryptography.hazmat.primitives.asymmetric import ec


_OPTION = "--passphrase-file"


def init(arguments: argparse.Namespace) -> str:
    """Make a CA."""
    AuthorityFolder(arguments.dir).refuse_existing()
    source = PassphraseSource("passphrase for the CA's key", _OPTION, VARIABLE, arguments.passphrase_file)
    passphrase = None if arguments.no_passphrase else source.choose()
    folder = AuthorityFolder(arguments.dir, passphrase)
    authority = Authority.create(arguments.name, days=arguments.days)
    folder.create(authority)
    kept = "not encrypted" if passphrase is None else "encrypted"
    until = listing.day(authority.not_after)
    return f"made the CA {arguments.name}, valid until {until}; its key is {kept}: {folder.path}"


def issue(arguments: argparse.Namespace) -> str:
    """Write a new node's files."""
    folder = opened(arguments)
    role = IdentityRole(arguments.role)
    with folder.locked() as authority:
        out = arguments.out or folder.node_folder(arguments.name)
        refuse_taken(out, arguments.name, own=arguments.out is None)
        issued = authority.issue(arguments.name, role, days=arguments.days)
        save(folder, authority)
        write_tls_files(out, issued, authority.ca_pem, authority.crl_pem())
    until = listing.day(issued.certificate.not_valid_after_utc.timestamp())
    return f"issued {arguments.name} ({role.value}), valid until {until}: {out}"


def renew(arguments: argparse.Namespace) -> str:
    """Write a node's files with a further certificate."""
    folder = opened(arguments)
    with folder.locked() as authority:
        out = arguments.out or folder.node_folder(arguments.name)
        last = authority.latest(arguments.name)
        refuse_taken(out, arguments.name, own=arguments.out is None)
        key = kept_key(out) if arguments.keep_key else None
        issued = authority.renew(arguments.name, days=arguments.days, key=key)
        save(folder, authority)
        write_tls_files(out, issued, authority.ca_pem, authority.crl_pem())
    until = listing.day(issued.certificate.not_valid_after_utc.timestamp())
    return f"renewed {arguments.name} ({last.role.value}), valid until {until}: {out}"


def revoke(arguments: argparse.Namespace) -> str:
    """Revoke a node's certificates."""
    folder = opened(arguments)
    with folder.locked() as authority:
        revoked = authority.revoke(arguments.name, x509.ReasonFlags(arguments.reason))
        save(folder, authority)
    what = f"{len(revoked)} certificate{'s' * (len(revoked) != 1)} of {arguments.name}"
    where = "copy it to the tls_dir of the control plane, or of any node"
    return f"revoked {what}; {where}: {folder.path / CRL_FILE}"


def publish(arguments: argparse.Namespace) -> str:
    """Sign the revocation lists again."""
    folder = opened(arguments)
    with folder.locked() as authority:
        authority.publish()
        save(folder, authority)
    return f"signed revocation list {authority.crl_number}; copy it to any node's tls_dir: {folder.path / CRL_FILE}"


def show(arguments: argparse.Namespace) -> str:
    """List what was issued."""
    folder = AuthorityFolder(arguments.dir)
    records = folder.records()
    return listing.render(records, [folder.certificate(record) for record in records], time.time())


def rotate(arguments: argparse.Namespace) -> str:
    """Put a new CA before the one in use."""
    folder = opened(arguments)
    with folder.locked() as authority:
        authority.rotate(arguments.name, days=arguments.days)
        save(folder, authority)
    files = f"{folder.path / CA_FILE} and {folder.path / CRL_FILE}"
    return f"made the CA {arguments.name}; before you renew any node, copy to every tls_dir: {files}"


def retire(arguments: argparse.Namespace) -> str:
    """Forget the former CAs."""
    folder = opened(arguments)
    with folder.locked() as authority:
        authority.retire()
        save(folder, authority)
    return f"retired the former CAs; copy to every tls_dir: {folder.path / CA_FILE} and {folder.path / CRL_FILE}"


def change_passphrase(arguments: argparse.Namespace) -> str:
    """Encrypt the CA's key with another passphrase, by the current method."""
    folder = opened(arguments, warn=False)
    source = PassphraseSource("new passphrase", "--new-passphrase-file", NEW_VARIABLE, arguments.new_passphrase_file)
    new = None if arguments.no_passphrase else source.choose()
    folder.change_passphrase(new)
    kept = "no longer encrypted" if new is None else "encrypted with the new passphrase; older copies of it are not"
    return f"the CA's key is {kept}: {folder.path}"


def opened(arguments: argparse.Namespace, *, warn: bool = True) -> AuthorityFolder:
    """Return the CA's folder with the passphrase of its keys, if they have one; raises ConfigError.

    If the user must be asked for it, that happens before the folder is locked.
    """
    folder = AuthorityFolder(arguments.dir)
    protections = folder.protections()
    if warn and min(protections) is not Protection.GOOD:
        how = "not encrypted" if min(protections) is Protection.CLEAR else "encrypted by an old, weak method"
        _warn(f"{folder.path}: the CA's key is {how}; do: {_mend(arguments)}")
    if max(protections) is Protection.CLEAR:
        if arguments.passphrase_file is not None:
            raise ConfigError(str(folder.path), "", f"the CA's key has no passphrase; leave out {_OPTION}")
        return AuthorityFolder(arguments.dir, on_wait=_tell_of_wait)
    source = PassphraseSource("passphrase of the CA's key", _OPTION, VARIABLE, arguments.passphrase_file)
    return AuthorityFolder(arguments.dir, source.get(), _tell_of_wait)


def _warn(problem: str) -> None:
    sys.stderr.write(f"plr: warning: {escaped(problem)}\n")


def _tell_of_wait() -> None:
    sys.stderr.write("plr: another plr ca command is using this folder; waiting for it\n")
    sys.stderr.flush()


def _mend(arguments: argparse.Namespace) -> str:
    return shlex.join(["plr", "ca", "passphrase", "--dir", str(arguments.dir)])


def save(folder: AuthorityFolder, authority: Authority) -> None:
    """Save the CA, and warn of nodes' folders that could not be updated; raises OSError."""
    for problem in folder.save(authority):
        _warn(problem)


def refuse_taken(out: Path, name: str, *, own: bool) -> None:
    """Raise AuthorityError if the folder holds the key or the certificate of a node with another name, or OSError as
    `refuse_planted` does.

    `own` marks the CA's own folder for this name, where an interrupted command may leave a key without a certificate.
    """
    if out.exists():
        refuse_planted(out)
    path = out / CERTIFICATE_FILE
    if not path.exists() and (own or not (out / KEY_FILE).exists()):
        return
    try:
        # The folder may belong to the node's user, who may put anything there.
        certificate = x509.load_pem_x509_certificate(read_regular(path, MAX_TLS_FILE_BYTES))
        owners = [each.value for each in certificate.subject.get_attributes_for_oid(NameOID.COMMON_NAME)]
    except (OSError, ValueError):
        owners = []
    if owners != [name]:
        raise AuthorityError(f"{out}: holds another node's files; give another --out")


def kept_key(out: Path) -> ec.EllipticCurvePrivateKey:
    """Return the key of a node's folder; raises ConfigError."""
    path = out / KEY_FILE
    return load_private_key(read_guarded(path, KEY_FORBIDDEN), None, path)
