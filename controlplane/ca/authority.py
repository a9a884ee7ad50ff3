"""Implements a CA in memory: it issues, renews and revokes, and remembers what it has issued."""

from __future__ import annotations

import dataclasses
import difflib
import time
from typing import TYPE_CHECKING

from cryptography import x509
from cryptography.hazmat.primitives.serialization import Encoding

from plr.controlplane.ca.certificates import (
    Issued,
    Validity,
    build_authority,
    build_leaf,
    build_revocation_list,
    generate_key,
)
from plr.controlplane.ca.files import write_tls_files
from plr.controlplane.ca.index import Entry, Record
from plr.controlplane.ca.request import fingerprint
from plr.protos.model.names import node_name
from plr.protos.trust.identity import MAX_CA_CERTIFICATES

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable
    from pathlib import Path

    from cryptography.hazmat.primitives.asymmetric import ec

    from plr.controlplane.ca.request import CertificateRequest
    from plr.protos.trust.identity import IdentityRole

DAY_S = 86_400.0

DEFAULT_CA_DAYS = 3650.0
DEFAULT_DAYS = 90.0
"""Validity of a node's certificate: short enough that a key lost unnoticed expires, long enough to renew by hand."""

BACKDATE_S = 300.0
"""How far the start of a certificate is backdated: robots whose clocks are this slow still find it valid."""


class AuthorityError(ValueError):
    """The CA refuses; the text is one line that says what to do."""


class Authority:
    """A CA with its key, and the former CAs that nodes still trust. Times come from `clock` (seconds since 1970)."""

    def __init__(
        self,
        own: Issued,
        entries: Iterable[Entry] = (),
        crl_number: int = 0,
        former: Iterable[Authority] = (),
        clock: Callable[[], float] = time.time,
        published_at: float | None = None,
        past: Iterable[Entry] = (),
    ) -> None:
        self.own = own
        self.entries = list(entries)
        self.crl_number = crl_number
        self.published_at = published_at
        self.former = list(former)
        self._past = list(past)
        """One certificate of each key that a retired CA certified: a revoked one if there is one."""
        self._clock = clock

    @classmethod
    def create(
        cls, name: str = "fleet", *, days: float = DEFAULT_CA_DAYS, clock: Callable[[], float] = time.time
    ) -> Authority:
        """Make a new CA; `name` is for human readers."""
        return cls(_own(name, days, clock()), clock=clock)

    @property
    def ca_pem(self) -> bytes:
        """The CA's certificate, followed by those of the former CAs."""
        return b"".join(authority.own.certificate_pem for authority in (self, *self.former))

    @property
    def not_after(self) -> float:
        """Expiry of the CA's certificate."""
        return self.own.certificate.not_valid_after_utc.timestamp()

    def record(self) -> Record:
        """Return what must be stored of this CA besides its key and certificate."""
        serial, entries = self.own.certificate.serial_number, tuple(self.entries)
        return Record(serial, self.crl_number, entries, self.published_at, tuple(self._past))

    def all_entries(self) -> list[Entry]:
        """Return what the former CAs and this one have issued, oldest first."""
        return [entry for authority in (*reversed(self.former), self) for entry in authority.entries]

    def issue(
        self, name: str, role: IdentityRole, *, days: float = DEFAULT_DAYS, validity: Validity | None = None
    ) -> Issued:
        """Make a key and certificate for a new name; raises AuthorityError, or DecodeError for a bad name.

        `validity` in place of `days` is for tests: it may lie in the past, but not beyond the CA's own end.
        """
        node_name(name, "the name")
        self._refuse_in_force(name, f"plr ca renew {name}")
        return self._issue(name, role, validity or self._validity(days), generate_key())

    def renew(self, name: str, *, days: float = DEFAULT_DAYS, key: ec.EllipticCurvePrivateKey | None = None) -> Issued:
        """Make a further certificate for a name, and a new key unless one is given; raises AuthorityError.

        The previous certificate stays valid until its end, so that the node can switch without a gap.
        """
        last = self._renewable(name)
        if key is not None:
            self._refuse_key(name, fingerprint(key.public_key()), "the key", "leave out --keep-key")
        return self._issue(name, last.role, self._validity(days), key or generate_key())

    def sign(
        self, request: CertificateRequest, *, renewing: bool = False, days: float = DEFAULT_DAYS
    ) -> x509.Certificate:
        """Certify the key of a request whose name and role the operator has confirmed; raises AuthorityError.

        It works like `issue`, or `renew`. A key serves one name only, and none once it was revoked.
        """
        name = request.name
        self._refuse_key(
            name,
            fingerprint(request.key),
            "the request's key",
            f"make another on the node: plr request {name} --role ...",
        )
        if not renewing:
            self._refuse_in_force(name, "plr ca sign --renew")
        elif (last := self._renewable(name)).role is not request.role:
            roles = f"{last.role.value}, not {request.role.value}"
            raise AuthorityError(f"{name} has the role {roles}; to change it, do first: plr ca revoke {name}")
        return self._certify(name, request.role, self._validity(days), request.key)

    def _refuse_key(self, name: str, key: str, what: str, instead: str) -> None:
        for entry in (*self._past, *self.all_entries()):
            if entry.key == key and entry.name != name:
                raise AuthorityError(f"{what} belongs to {entry.name}; {instead}")
            if entry.key == key and entry.revoked_at is not None:
                raise AuthorityError(f"{what} was revoked; {instead}")

    def _refuse_in_force(self, name: str, instead: str) -> None:
        now = self._clock()
        if any(entry.name == name and entry.in_force(now) for entry in self.all_entries()):
            raise AuthorityError(f"{name} has a certificate; do: {instead}")

    def _renewable(self, name: str) -> Entry:
        last = self.latest(name)
        if last.revoked_at is not None:
            raise AuthorityError(
                f"{name} is revoked; to let it in again, do: plr ca issue {name} --role ..., or plr ca sign"
            )
        return last

    def revoke(self, name: str, reason: x509.ReasonFlags = x509.ReasonFlags.unspecified) -> list[Entry]:
        """Revoke and return all certificates in force of a name; raises AuthorityError if there is none."""
        self.latest(name)
        revoked = [entry for authority in (self, *self.former) for entry in authority._revoke(name, reason)]
        if not revoked:
            raise AuthorityError(f"{name} has no certificate in force")
        return revoked

    def _revoke(self, name: str, reason: x509.ReasonFlags) -> list[Entry]:
        now = self._clock()
        revoked = []
        for place, entry in enumerate(self.entries):
            if entry.name == name and entry.in_force(now):
                self.entries[place] = dataclasses.replace(entry, revoked_at=now, reason=reason.value)
                revoked.append(self.entries[place])
        if revoked:
            self.crl_number += 1
            self.published_at = now
        return revoked

    def adopt(self, lists: Iterable[x509.CertificateRevocationList]) -> None:
        """Take over lists that this CA signed but does not remember, because a command was interrupted.

        A node may have such a list: what it revokes stays revoked, and the next list has a higher number.
        """
        for one in lists:
            if one.issuer != self.own.certificate.subject or not one.is_signature_valid(self.own.key.public_key()):
                continue
            number = one.extensions.get_extension_for_class(x509.CRLNumber).value.crl_number
            if number <= self.crl_number:
                continue
            self.crl_number = number
            self.published_at = one.last_update_utc.timestamp()
            for place, entry in enumerate(self.entries):
                revoked = one.get_revoked_certificate_by_serial_number(entry.serial)
                if revoked is not None and entry.revoked_at is None:
                    at = revoked.revocation_date_utc.timestamp()
                    self.entries[place] = dataclasses.replace(entry, revoked_at=at, reason=_reason(revoked))

    def publish(self) -> None:
        """Sign the revocation lists again, unchanged, so that nodes can see that they miss none.

        The list of an expired former CA stays: nobody trusts that CA any more. Raises AuthorityError if this one has
        expired.
        """
        now = self._clock()
        if now >= self.not_after:
            raise AuthorityError("the CA's certificate has expired; if this clock is right, do: plr ca rotate")
        for authority in (self, *self.former):
            if now < authority.not_after:
                authority.crl_number += 1
                authority.published_at = now

    def rotate(self, name: str, *, days: float = DEFAULT_CA_DAYS) -> None:
        """Make a new CA that issues from now on; the previous one stays trusted until `retire`.

        No node may present a certificate of the new CA before the others have its `ca_pem`.
        """
        if len(self.former) + 1 >= MAX_CA_CERTIFICATES:
            raise AuthorityError(f"nodes trust at most {MAX_CA_CERTIFICATES} CAs; do first: plr ca retire")
        before = Authority(self.own, self.entries, self.crl_number, clock=self._clock, published_at=self.published_at)
        self.own, self.entries, self.crl_number, self.published_at = _own(name, days, self._clock()), [], 0, None
        self.former.insert(0, before)

    def retire(self) -> None:
        """Forget the former CAs; raises AuthorityError while a node has only a certificate of theirs."""
        now = self._clock()
        renewed = {entry.name for entry in self.entries if entry.in_force(now)}
        waiting = sorted({entry.name for entry in self.all_entries() if entry.in_force(now)} - renewed)
        if waiting:
            raise AuthorityError(
                "these nodes have only a certificate of the former CA; renew or revoke them first: "
                + ", ".join(waiting[:5])
                + (f" and {len(waiting) - 5} more" if len(waiting) > 5 else "")
            )
        # Their certificates end with them, but not the nodes' keys: a request may present one again.
        past = {entry.key: entry for entry in self._past}
        for authority in reversed(self.former):
            for entry in authority.entries:
                known = past.get(entry.key)
                if entry.key and (known is None or known.revoked_at is None):
                    past[entry.key] = entry
        self._past = list(past.values())
        self.former.clear()

    def latest(self, name: str) -> Entry:
        """Return the entry of the name's newest certificate; raises AuthorityError for an unknown name."""
        for entry in reversed(self.all_entries()):
            if entry.name == name:
                return entry
        close = difflib.get_close_matches(name, {entry.name for entry in self.all_entries()}, n=1)
        meant = f"did you mean {close[0]}?" if close else "plr ca list shows the names that have one"
        new = "a new node gets one from plr ca issue or plr ca sign"
        raise AuthorityError(f"{name} has no certificate of this CA; {meant}; {new}")

    def crl_pem(self) -> bytes:
        """Return the revocation lists of this CA and the former ones; each is valid as long as its CA.

        The bytes stay the same until a revocation, or `publish`.
        """
        return b"".join(authority._own_crl_pem() for authority in (self, *self.former))

    def _own_crl_pem(self) -> bytes:
        revoked = [
            (entry.serial, entry.revoked_at, entry.reason) for entry in self.entries if entry.revoked_at is not None
        ]
        begin = self.own.certificate.not_valid_before_utc.timestamp()
        # Older versions recorded no time of publication.
        signed_at = self.published_at or max((begin, *(revoked_at for _, revoked_at, _ in revoked)))
        validity = Validity(signed_at, self.not_after)
        return build_revocation_list(self.own, self.crl_number, revoked, validity).public_bytes(Encoding.PEM)

    def write_tls_dir(
        self,
        folder: Path,
        name: str,
        role: IdentityRole,
        *,
        days: float = DEFAULT_DAYS,
        validity: Validity | None = None,
    ) -> Issued:
        """Issue to a new name and write a folder that can serve as `tls_dir`; raises as `issue`, and OSError."""
        issued = self.issue(name, role, days=days, validity=validity)
        write_tls_files(folder, issued, self.ca_pem, self.crl_pem())
        return issued

    def _validity(self, days: float) -> Validity:
        now = self._clock()
        end = now + days * DAY_S
        if end > self.not_after:
            left = max(0, int((self.not_after - now) // DAY_S))
            raise AuthorityError(
                f"the CA's certificate expires in {left} days; give fewer --days, or make a new CA: plr ca rotate"
            )
        return Validity(now - BACKDATE_S, end)

    def _issue(self, name: str, role: IdentityRole, validity: Validity, key: ec.EllipticCurvePrivateKey) -> Issued:
        return Issued(self._certify(name, role, validity, key.public_key()), key)

    def _certify(
        self, name: str, role: IdentityRole, validity: Validity, key: ec.EllipticCurvePublicKey
    ) -> x509.Certificate:
        certificate = build_leaf(self.own, name, role, key, validity)
        self.entries.append(
            Entry(
                name=node_name(name, "the name"),
                role=role,
                serial=certificate.serial_number,
                not_before=certificate.not_valid_before_utc.timestamp(),
                not_after=certificate.not_valid_after_utc.timestamp(),
                key=fingerprint(key),
            )
        )
        return certificate


def _reason(revoked: x509.RevokedCertificate) -> str:
    try:
        return revoked.extensions.get_extension_for_class(x509.CRLReason).value.reason.value
    except x509.ExtensionNotFound:
        return x509.ReasonFlags.unspecified.value


def _own(name: str, days: float, now: float) -> Issued:
    key = generate_key()
    return Issued(build_authority(name, key, Validity(now - BACKDATE_S, now + days * DAY_S)), key)
