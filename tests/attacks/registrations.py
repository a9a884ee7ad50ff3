"""What a sidecar says first to the control plane, under whatever name, role and certificate the test likes."""

from __future__ import annotations

import hashlib
import time
from typing import TYPE_CHECKING

from protos.convert import sidecar_message_to_proto
from protos.credential import Aead, SessionCredential, session_number
from protos.model import PROTOCOL_VERSION, NodeName, Registration, Role, Version

if TYPE_CHECKING:
    from controlplane.ca import Issued


def registration(issued: Issued, name: str, role: Role, incarnation: int | None = None) -> bytes:
    """An encoded registration with a credential signed by this certificate's key."""
    incarnation = int(time.time() * 1000.0) if incarnation is None else incarnation
    public_key = hashlib.sha256(f"{name} {incarnation}".encode()).digest()
    session = session_number(NodeName(name), role, public_key)
    credential = SessionCredential(
        NodeName(name), role, session, incarnation, public_key, Aead.AES_256_GCM, issued.certificate_der
    ).sign(issued.key)
    said = Registration(
        protocol_version=PROTOCOL_VERSION,
        name=NodeName(name),
        role=role,
        session=session,
        token=bytes(range(16)),
        incarnation=incarnation,
        software_version="attack",
        peers_version=Version(0),
        mapping_version=Version(0),
        credential=credential.encode(),
    )
    return sidecar_message_to_proto(said).SerializeToString()
