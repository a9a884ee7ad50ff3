"""Whether what a registration says of the sidecar is what its certificate says. Pure functions."""

from __future__ import annotations

from typing import TYPE_CHECKING

from controlplane.core.registry.registry import Refusal
from protos.base.errors import DecodeError
from protos.trust.credential import decode_credential, verify

if TYPE_CHECKING:
    from protos.model.members import Registration
    from protos.trust.identity import Identity


def check_claims(registration: Registration, identity: Identity, certificate: bytes) -> Refusal | None:
    """Return why the registration is not what the holder of this certificate (DER) may say, or None."""
    if registration.name != identity.name:
        return Refusal.NAME_MISMATCH
    if registration.role.value != identity.role.value:
        return Refusal.WRONG_ROLE
    if not _is_own(registration, certificate, identity):
        return Refusal.BAD_CREDENTIAL
    return None


def check_unproven_claims(registration: Registration) -> Refusal | None:
    """The same where nobody has certificates: the credential, if any, has at least to agree with the registration."""
    if registration.credential and not _is_own(registration):
        return Refusal.BAD_CREDENTIAL
    return None


def _is_own(registration: Registration, certificate: bytes = b"", identity: Identity | None = None) -> bool:
    """The peers check it themselves; here it is about a clear answer to a sidecar that presents another's."""
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
