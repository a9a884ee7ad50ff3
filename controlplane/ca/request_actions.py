"""Carries out `plr request` and `plr ca sign`: a certificate for a key that stays on its node."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING

from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.serialization import Encoding

from plr.controlplane.ca import listing
from plr.controlplane.ca.actions import kept_key, opened, refuse_taken, save
from plr.controlplane.ca.authority import AuthorityError
from plr.controlplane.ca.certificates import generate_key
from plr.controlplane.ca.files import PRIVATE_FILE, PUBLIC_FILE, make_private, write_atomically, write_certificate
from plr.controlplane.ca.folder import AuthorityFolder
from plr.controlplane.ca.key_file import clear_pem
from plr.controlplane.ca.request import (
    MAX_CERTIFICATE_REQUEST_BYTES,
    REQUEST_FILE,
    build_request,
    fingerprint,
    parse_request,
)
from plr.protos.base.errors import ConfigError, DecodeError
from plr.protos.base.printable import escaped
from plr.protos.program.regular_file import read_regular
from plr.protos.program.tls_files import KEY_FILE
from plr.protos.trust.identity import IdentityRole

if TYPE_CHECKING:
    import argparse
    from collections.abc import Iterable
    from pathlib import Path

    from plr.controlplane.ca.index import Record
    from plr.controlplane.ca.request import CertificateRequest

_MAY = {
    IdentityRole.ROBOT: "may call services",
    IdentityRole.CLOUD: "may offer services",
    IdentityRole.CONTROL_PLANE: "may tell every sidecar the addresses of the others",
    IdentityRole.OPERATOR: "may ask the control plane about every node",
}


def request(arguments: argparse.Namespace) -> str:
    """Make a key and a request for a certificate of it."""
    out: Path = arguments.out
    role = IdentityRole(arguments.role)
    key = _own_key(out, arguments.name) if arguments.keep_key else _new_key(out)
    write_atomically(out / REQUEST_FILE, build_request(arguments.name, role, key), PUBLIC_FILE)
    return "\n".join(
        (
            f"wrote a request for {arguments.name} ({role.value}): {out / REQUEST_FILE}",
            f"its key is {fingerprint(key.public_key())} and stays here: {out / KEY_FILE}",
            f"copy {REQUEST_FILE} to where the CA is, and there do: plr ca sign {REQUEST_FILE}",
        )
    )


def sign(arguments: argparse.Namespace) -> str:
    """Certify the key of a request, with the name and role that the operator confirms."""
    asked = _read(arguments.request)
    _confirm(arguments, asked, AuthorityFolder(arguments.dir).records())
    folder = opened(arguments)
    with folder.locked() as authority:
        out = arguments.out or folder.node_folder(asked.name)
        if (out / KEY_FILE).exists():
            raise AuthorityError(f"{out}: holds a key that is not the request's; delete it or give another --out")
        refuse_taken(out, asked.name, own=arguments.out is None)
        certificate = authority.sign(asked, renewing=arguments.renew, days=arguments.days)
        save(folder, authority)
        write_certificate(out, certificate.public_bytes(Encoding.PEM), authority.ca_pem, authority.crl_pem())
    until = listing.day(certificate.not_valid_after_utc.timestamp())
    return f"signed {asked.name} ({asked.role.value}), valid until {until}; copy to where its key is: {out}"


def _new_key(out: Path) -> ec.EllipticCurvePrivateKey:
    if (out / KEY_FILE).exists():
        raise AuthorityError(f"{out}: already holds a key; give another --out, or --keep-key to certify it")
    make_private(out)
    key = generate_key()
    write_atomically(out / KEY_FILE, clear_pem(key), PRIVATE_FILE)
    return key


def _own_key(out: Path, name: str) -> ec.EllipticCurvePrivateKey:
    key = kept_key(out)
    if not isinstance(key.curve, ec.SECP256R1):
        raise AuthorityError(
            f"{out / KEY_FILE}: is not on P-256; make another one without --keep-key: plr request {name} --role ..."
        )
    return key


def _read(path: Path) -> CertificateRequest:
    try:
        pem = read_regular(path, MAX_CERTIFICATE_REQUEST_BYTES + 1)
    except OSError as error:
        raise AuthorityError(f"{path}: cannot be read: {error.strerror or error}") from error
    try:
        return parse_request(pem)
    except DecodeError as error:
        raise AuthorityError(f"{path}: {error}; make it with: plr request") from error


def _confirm(arguments: argparse.Namespace, asked: CertificateRequest, records: Iterable[Record]) -> None:
    """Return if the operator confirms this, by options or at the terminal; raises AuthorityError or ConfigError."""
    name, role, key = asked.name, asked.role.value, fingerprint(asked.key)
    for what, wanted, found in (
        ("name", arguments.name, name),
        ("role", arguments.role, role),
        ("key", arguments.fingerprint, key),
    ):
        if wanted not in (None, found):
            raise AuthorityError(f"{arguments.request}: asks for the {what} {found}, not {wanted}; nothing was signed")
    if arguments.name is not None and arguments.role is not None:
        return
    if sys.stdin is None or not sys.stdin.isatty():
        problem = f"asks for the name {name} and the role {role}, and there is no terminal to confirm that"
        raise ConfigError(str(arguments.request), "", f"{problem}; give --name and --role")
    sys.stderr.write(
        f"{escaped(str(arguments.request))} asks for\n"
        f"  name  {name}, which has {_state(records, name)}\n"
        f"  role  {role}, which {_MAY[asked.role]}\n"
        f"  key   {key}; compare it with what plr request showed\n"
        "type the role to sign it, anything else to refuse: "
    )
    sys.stderr.flush()
    if _typed() != role:
        raise AuthorityError("not confirmed; nothing was signed")


def _typed() -> str:
    try:
        return sys.stdin.readline().strip()
    except UnicodeError:
        return ""


def _state(records: Iterable[Record], name: str) -> str:
    entries = [entry for record in records for entry in record.entries if entry.name == name]
    if not entries:
        return "no certificate yet"
    newest = max(entries, key=lambda entry: entry.not_before)
    if newest.revoked_at is not None:
        return f"a certificate as {newest.role.value} that was revoked on {listing.day(newest.revoked_at)}"
    return f"a certificate as {newest.role.value} until {listing.day(newest.not_after)}"
