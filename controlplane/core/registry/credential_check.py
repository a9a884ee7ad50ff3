"""Checks whether a registration says of the sidecar what its certificate says. Pure functions."""

from __future__ import annotations

from typing import TYPE_CHECKING

from plr.controlplane.core.registry.registry import Refusal
from plr.protos.base.errors import DecodeError
from plr.protos.trust.credential import decode_credential, verify

if TYPE_CHECKING:
    from plr.protos.model.members import Registration
    from plr.protos.trust.identity import Identity


def check_claims(registration: Registration, identity: Identity, certificate: bytes) -> Refusal | None:
    """Return why the holder of this certificate (DER) may not claim this registration, or None."""
    if registration.name != identity.name:
        return Refusal.NAME_MISMATCH
    if registration.role.value != identity.role.value:
        return Refusal.WRONG_ROLE
    if not _is_own(registration, certificate, identity):
        return Refusal.BAD_CREDENTIAL
    return None


def check_unproven_claims(registration: Registration) -> Refusal | None:
    """Do the same where nobody has certificates: a credential, if any, must at least agree with the registration."""
    if registration.credential and not _is_own(registration):
        return Refusal.BAD_CREDENTIAL
    return None


def _is_own(registration: Registration, certificate: bytes = b"", identity: Identity | None = None) -> bool:
    """Return whether the credential is its own: peers check it too; this gives a clear answer to one with another's."""
    try:
        credential = decode_credential(registration.credential)
        said = (credential.name, credential.role, credential.session, credential.incarnation, credential.certificate)
        known = (registration.name, registration.role, registration.session, registration.incarnation, certificate)
        if said != known:
            return False
        if identity is not None:
            verify(credential, lambda _: identity)
    except DecodeError:
        return False
    return True
