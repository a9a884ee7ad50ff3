"""Registrations with certificates that a test has just had issued."""

from __future__ import annotations

from typing import TYPE_CHECKING

from lab.attacker import registration as attacker

if TYPE_CHECKING:
    from plr.controlplane.ca import Issued
    from plr.protos.model.ids import Role


def registration(issued: Issued, name: str, role: Role, incarnation: int | None = None) -> bytes:
    """An encoded registration with a credential signed by this certificate's key."""
    return attacker.registration(issued.certificate_der, issued.key, name, role, incarnation)
