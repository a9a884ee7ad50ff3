"""Reads from a DDS id (GUID) what it says about the process behind an endpoint.

    0       2         4        6        8             12          16
    | vendor | host id | pid   | random | participant | entity id |      the first 12 bytes: the participant

The pid field holds the lowest 16 bits of the process id in the process's own namespace, little-endian. This is the
format of Fast DDS (vendor 1.15); in other vendors' ids only the participant has a meaning here.
"""

from __future__ import annotations

ENDPOINT_BYTES = 16
PARTICIPANT_BYTES = 12
_PROCESS_BYTES = 8
_FAST_DDS = b"\x01\x0f"


def participant_of(endpoint: bytes) -> bytes:
    """Return the leading bytes of the id that all endpoints of a participant share."""
    return endpoint[:PARTICIPANT_BYTES]


def process_of(endpoint: bytes) -> bytes:
    """Return the bytes that all participants of a process share."""
    return endpoint[:_PROCESS_BYTES]


def pid_bits(endpoint: bytes) -> int | None:
    """Return the lowest 16 bits of the endpoint's process id, or None where its DDS id does not hold them."""
    if len(endpoint) < PARTICIPANT_BYTES or not endpoint.startswith(_FAST_DDS):
        return None
    return int.from_bytes(endpoint[4:6], "little")
