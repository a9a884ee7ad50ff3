"""The token by which one sidecar introduces itself to one other, who can forge introductions to nobody else with it.

Each sidecar has one token of its own, which the control plane alone is told. What a peer holds of it, also on disk,
follows from that (HKDF-Expand with SHA-256, RFC 5869 section 2.3)::

    pair token (16 bytes) = Expand(own token, "plr 2 pair token" | receiver's role (8): 1 robot, 2 cloud | its name)

The sidecar derives it for itself, the control plane for every peer whom it tells of the sidecar.
"""

from __future__ import annotations

import hmac
from typing import TYPE_CHECKING

from protos.model.ids import Role
from protos.model.members import TOKEN_BYTES

if TYPE_CHECKING:
    from protos.model.ids import NodeName

_LABEL = b"plr 2 pair token"
_HEADS = {Role.ROBOT: _LABEL + b"\1", Role.CLOUD: _LABEL + b"\2"}
_FIRST_BLOCK = b"\1"
"""The counter of RFC 5869; more than 32 bytes would need another block."""


def pair_token(token: bytes, receiver: NodeName, role: Role) -> bytes:
    """Return what the owner of `token` introduces itself with to the receiver of this name and role.

    One HMAC in C, 1 to 2 us: to keep it would cost the control plane more than to make it again.
    """
    return hmac.digest(token, _HEADS[role] + receiver.encode() + _FIRST_BLOCK, "sha256")[:TOKEN_BYTES]
