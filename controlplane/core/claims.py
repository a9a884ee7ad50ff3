"""Whether what a registration says of the sidecar is what its certificate says. Pure functions."""

from __future__ import annotations

from typing import TYPE_CHECKING

from controlplane.core.registry import Refusal

if TYPE_CHECKING:
    from protos.identity import Identity
    from protos.model import Registration


def check_claims(registration: Registration, identity: Identity) -> Refusal | None:
    """Return why the registration is not what the holder of this certificate may say, or None."""
    if registration.name != identity.name:
        return Refusal.NAME_MISMATCH
    if registration.role.value != identity.role.value:
        return Refusal.WRONG_ROLE
    return None
