"""What the commands of `plr ca` do; they raise AuthorityError, ConfigError or OSError, and print one line."""

from __future__ import annotations

import sys
import time
from typing import TYPE_CHECKING

from cryptography import x509
from cryptography.x509.oid import NameOID

from controlplane.ca import listing
from controlplane.ca.authority import Authority, AuthorityError
from controlplane.ca.files import write_tls_files
from controlplane.ca.folder import NOT_THE_OWNER, AuthorityFolder
from protos.errors import ConfigError
from protos.identity import IdentityRole
from protos.tls_files import (
    CA_FILE,
    CERTIFICATE_FILE,
    CRL_FILE,
    KEY_FILE,
    KEY_FORBIDDEN,
    load_private_key,
    read_guarded,
)

if TYPE_CHECKING:
    import argparse
    from pathlib import Path

    from cryptography.hazmat.primitives.asymmetric import ec


def init(arguments: argparse.Namespace) -> None:
    """Make a CA."""
    folder = _folder(arguments)
    authority = Authority.create(arguments.name, days=arguments.days)
    folder.create(authority)
    _say(f"made the CA {arguments.name}, good until {listing.day(authority.not_after)}: {folder.path}")


def issue(arguments: argparse.Namespace) -> None:
    """Write a new node's files."""
    folder = _folder(arguments)
    role = IdentityRole(arguments.role)
    with folder.locked() as authority:
        out = arguments.out or folder.node_folder(arguments.name)
        _refuse_taken(out, arguments.name)
        issued = authority.issue(arguments.name, role, days=arguments.days)
        folder.save(authority)
        write_tls_files(out, issued, authority.ca_pem, authority.crl_pem())
    until = listing.day(issued.certificate.not_valid_after_utc.timestamp())
    _say(f"issued {arguments.name} ({role.value}), good until {until}: {out}")


def renew(arguments: argparse.Namespace) -> None:
    """Write a node's files with a further certificate."""
    folder = _folder(arguments)
    with folder.locked() as authority:
        out = arguments.out or folder.node_folder(arguments.name)
        last = authority.latest(arguments.name)
        _refuse_taken(out, arguments.name)
        key = _kept_key(out) if arguments.keep_key else None
        issued = authority.renew(arguments.name, days=arguments.days, key=key)
        folder.save(authority)
        write_tls_files(out, issued, authority.ca_pem, authority.crl_pem())
    until = listing.day(issued.certificate.not_valid_after_utc.timestamp())
    _say(f"renewed {arguments.name} ({last.role.value}), good until {until}: {out}")


def revoke(arguments: argparse.Namespace) -> None:
    """Revoke what a node has."""
    folder = _folder(arguments)
    with folder.locked() as authority:
        revoked = authority.revoke(arguments.name, x509.ReasonFlags(arguments.reason))
        folder.save(authority)
    where = "copy to the control plane's tls_dir, or any node's"
    _say(f"revoked {len(revoked)} of {arguments.name}; {where}: {folder.path / CRL_FILE}")


def publish(arguments: argparse.Namespace) -> None:
    """Sign the revocation lists again."""
    folder = _folder(arguments)
    with folder.locked() as authority:
        authority.publish()
        folder.save(authority)
    _say(f"signed revocation list {authority.crl_number}; copy to any node's tls_dir: {folder.path / CRL_FILE}")


def show(arguments: argparse.Namespace) -> None:
    """Print what was issued."""
    folder = _folder(arguments)
    records = folder.records()
    _say(listing.render(records, [folder.certificate(record) for record in records], time.time()))


def rotate(arguments: argparse.Namespace) -> None:
    """Put a new CA before the one in use."""
    folder = _folder(arguments)
    with folder.locked() as authority:
        authority.rotate(arguments.name, days=arguments.days)
        folder.save(authority)
    _say(f"made the CA {arguments.name}; before renewing any node, copy to every tls_dir: {folder.path / CA_FILE}")


def retire(arguments: argparse.Namespace) -> None:
    """Forget the former CAs."""
    folder = _folder(arguments)
    with folder.locked() as authority:
        authority.retire()
        folder.save(authority)
    _say(f"retired; copy to every tls_dir: {folder.path / CA_FILE} and {folder.path / CRL_FILE}")


def _folder(arguments: argparse.Namespace) -> AuthorityFolder:
    path: Path | None = getattr(arguments, "passphrase_file", None)
    if path is None:
        return AuthorityFolder(arguments.dir)
    passphrase = read_guarded(path, NOT_THE_OWNER).strip(b"\r\n")
    if not passphrase:
        raise ConfigError(str(path), "", "expected a passphrase")
    return AuthorityFolder(arguments.dir, passphrase)


def _refuse_taken(out: Path, name: str) -> None:
    """Raise AuthorityError if the folder holds the key of a node with another name."""
    if not (out / KEY_FILE).exists():
        return
    try:
        certificate = x509.load_pem_x509_certificate((out / CERTIFICATE_FILE).read_bytes())
        owners = [each.value for each in certificate.subject.get_attributes_for_oid(NameOID.COMMON_NAME)]
    except (OSError, ValueError):
        owners = []
    if owners != [name]:
        raise AuthorityError(f"{out}: holds another node's key; give another --out")


def _kept_key(out: Path) -> ec.EllipticCurvePrivateKey:
    path = out / KEY_FILE
    return load_private_key(read_guarded(path, KEY_FORBIDDEN), None, path)


def _say(line: str) -> None:
    sys.stdout.write(f"{line}\n")
