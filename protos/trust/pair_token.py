"""Derives the token by which a sidecar introduces itself to one peer, which can forge no introductions to others.

Each sidecar has its own token, which only the control plane knows. What a peer holds, also on disk, is derived from it
(HKDF-Expand with SHA-256, RFC 5869 section 2.3)::

    pair token (16 bytes) = Expand(own token, "plr 2 pair token" | receiver's role (8): 1 robot, 2 cloud | its name)

The sidecar derives it for itself, the control plane for every peer that it tells about the sidecar.
"""

from __future__ import annotations

import hmac
from typing import TYPE_CHECKING

from plr.protos.model.ids import Role
from plr.protos.model.members import TOKEN_BYTES

if TYPE_CHECKING:
    from plr.protos.model.ids import NodeName

_LABEL = b"plr 2 pair token"
_HEADS = {Role.ROBOT: _LABEL + b"\1", Role.CLOUD: _LABEL + b"\2"}
_FIRST_BLOCK = b"\1"
"""The counter of RFC 5869; more than 32 bytes would need another block."""


def pair_token(token: bytes, receiver: NodeName, role: Role) -> bytes:
    """Return the token by which the owner of `token` introduces itself to the receiver of this name and role.

    It takes one HMAC in C, 1 to 2 us: caching it would cost the control plane more than computing it again.
    """
    return hmac.digest(token, _HEADS[role] + receiver.encode() + _FIRST_BLOCK, "sha256")[:TOKEN_BYTES]
