"""What a DDS id (GUID) tells of the process behind an endpoint.

    0       2         4        6        8             12          16
    | vendor | host id | pid   | random | participant | entity id |      the first 12 bytes: the participant

The process id is its lowest 16 bits, little-endian, in the process's own namespace. So Fast DDS makes them
(vendor 1.15); of the others' ids only the participant means anything here.
"""

from __future__ import annotations

ENDPOINT_BYTES = 16
PARTICIPANT_BYTES = 12
_PROCESS_BYTES = 8
_FAST_DDS = b"\x01\x0f"


def participant_of(endpoint: bytes) -> bytes:
    """Return the first bytes of the id, which all endpoints of a participant share."""
    return endpoint[:PARTICIPANT_BYTES]


def process_of(endpoint: bytes) -> bytes:
    """Return the bytes that all participants of a process share."""
    return endpoint[:_PROCESS_BYTES]


def pid_bits(endpoint: bytes) -> int | None:
    """Return the lowest 16 bits of its process's id, or None where the id does not tell."""
    if len(endpoint) < PARTICIPANT_BYTES or not endpoint.startswith(_FAST_DDS):
        return None
    return int.from_bytes(endpoint[4:6], "little")
