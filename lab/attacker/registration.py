"""Makes a sidecar's first message to the control plane, under any name, role, session and key."""

from __future__ import annotations

import hashlib
import time
from typing import TYPE_CHECKING

from plr.protos.convert import sidecar_message_to_proto
from plr.protos.model.ids import PROTOCOL_VERSION, NodeName, Role, SessionId, Version
from plr.protos.model.members import Registration
from plr.protos.trust.credential import Aead, SessionCredential, session_number

if TYPE_CHECKING:
    from cryptography.hazmat.primitives.asymmetric import ec


def registration(
    certificate_der: bytes,
    key: ec.EllipticCurvePrivateKey,
    name: str,
    role: Role,
    incarnation: int | None = None,
    *,
    session: int | None = None,
    software_version: str = "attack",
) -> bytes:
    """Return an encoded registration with a credential signed by this key; `session` overrides the key's number."""
    incarnation = int(time.time() * 1000.0) if incarnation is None else incarnation
    public_key = hashlib.sha256(f"{name} {incarnation}".encode()).digest()
    number = session_number(NodeName(name), role, public_key) if session is None else SessionId(session)
    credential = SessionCredential(
        NodeName(name), role, number, incarnation, public_key, Aead.AES_256_GCM, certificate_der
    ).sign(key)
    said = Registration(
        protocol_version=PROTOCOL_VERSION,
        name=NodeName(name),
        role=role,
        session=number,
        token=bytes(range(16)),
        incarnation=incarnation,
        software_version=software_version,
        peers_version=Version(0),
        mapping_version=Version(0),
        credential=credential.encode(),
    )
    return sidecar_message_to_proto(said).SerializeToString()
