"""Parses what a ROS process announces about its nodes: rmw_dds_common/msg/ParticipantEntitiesInfo, as bytes in CDR.

    encapsulation       4 bytes
    gid                 16 bytes, of the participant
    nodes               length, and for each:
        namespace, name     strings: length with the NUL, characters
        readers, writers    length and 16 bytes for each endpoint

Lengths are 32 bits, aligned to 4 bytes. Any process of the ROS domain can send this. So every length is checked against
the bytes, and a message may have at most MAX_INFO_BYTES and MAX_NODES.
"""

from __future__ import annotations

import re
import struct
from typing import TYPE_CHECKING

from plr.sidecar.ros.cloud.dds_id import ENDPOINT_BYTES, PARTICIPANT_BYTES
from plr.sidecar.ros.errors import RosBridgeError

if TYPE_CHECKING:
    from collections.abc import Iterator

MAX_INFO_BYTES = 1 << 18
"""A process with a hundred nodes of 20 endpoints each sends 35 kB. This limit takes some milliseconds to parse."""
MAX_NODES = 512
"""Maximum number of nodes of one process."""
_ENCAPSULATION_BYTES = 4
_LITTLE_ENDIAN, _BIG_ENDIAN = b"\0\1", b"\0\0"
_NAMESPACE = re.compile(rb"/|(?:/[A-Za-z0-9_]+)+")
_NAME = re.compile(rb"[A-Za-z0-9_]+")
_MAX_NAME_BYTES = 256
"""Including the NUL; the limit in the message's definition."""


def speaker(info: bytes) -> bytes:
    """Return the id of the participant that the message is about; shorter if the message is cut off."""
    return info[_ENCAPSULATION_BYTES : _ENCAPSULATION_BYTES + PARTICIPANT_BYTES]


def nodes_of(info: bytes) -> Iterator[tuple[str, frozenset[bytes]]]:
    """Yield each node's full name and the DDS ids of its writers, which include those of its services' answers.

    Raises RosBridgeError where the bytes are no such message, perhaps after the first nodes.
    """
    if len(info) > MAX_INFO_BYTES:
        raise RosBridgeError(
            f"a process lists its nodes in {len(info)} bytes, but at most {MAX_INFO_BYTES} are allowed"
        )
    reader = _Reader(info)
    nodes = reader.length()
    if nodes > MAX_NODES:
        raise RosBridgeError(f"a process has {nodes} nodes, but at most {MAX_NODES} are allowed")
    for _ in range(nodes):
        namespace = reader.name(_NAMESPACE)
        name = reader.name(_NAME)
        reader.endpoints()
        writers = reader.endpoints()
        ids = (writers[at : at + ENDPOINT_BYTES] for at in range(0, len(writers), ENDPOINT_BYTES))
        yield f"{namespace.rstrip('/')}/{name}", frozenset(ids)


class _Reader:
    """Parses the bytes after the participant's id. All methods raise RosBridgeError."""

    def __init__(self, info: bytes) -> None:
        representation = info[:2]
        if representation not in (_LITTLE_ENDIAN, _BIG_ENDIAN):
            raise RosBridgeError(f"the list of a process's nodes has the unknown representation {representation.hex()}")
        self._length = struct.Struct("<I" if representation == _LITTLE_ENDIAN else ">I")
        self._info = info
        self._at = _ENCAPSULATION_BYTES + ENDPOINT_BYTES

    def length(self) -> int:
        begin = -(-self._at // 4) * 4
        self._at = begin + 4
        if self._at > len(self._info):
            raise RosBridgeError("the list of a process's nodes is truncated")
        (found,) = self._length.unpack_from(self._info, begin)
        return int(found)

    def endpoints(self) -> bytes:
        return self._take(self.length() * ENDPOINT_BYTES)

    def name(self, form: re.Pattern[bytes]) -> str:
        size = self.length()
        if not 0 < size <= _MAX_NAME_BYTES:
            raise RosBridgeError(f"a node's name or namespace has {size} bytes")
        text = self._take(size)
        if text[-1] or not form.fullmatch(text[:-1]):
            raise RosBridgeError(f"{text!r} is not a node's name or namespace")
        return text[:-1].decode("ascii")

    def _take(self, size: int) -> bytes:
        begin, self._at = self._at, self._at + size
        if self._at > len(self._info):
            raise RosBridgeError("the list of a process's nodes is truncated")
        return self._info[begin : self._at]
