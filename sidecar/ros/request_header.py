"""The identity rmw gave a request: which client sent it (writer guid) and its number there.

rclpy hands out `rmw_request_id_t` with the sequence number alone, although the C structure behind it holds both:

    struct rmw_request_id_s { uint8_t writer_guid[16]; int64_t sequence_number; }

The object is a pybind11 instance, whose first word after the Python object header points at that structure. It is read
from there, and believed only when the sequence number found beside it is the one that rclpy reports; otherwise all
clients count as one, which costs only the separate pacing of their answers.
"""

from __future__ import annotations

import ctypes
import sys
from typing import TYPE_CHECKING, Any

from sidecar.core.request_id import make_request_id

if TYPE_CHECKING:
    from protos.model import SessionId
    from sidecar.core.events import RequestId

_GUID_BYTES = 16
_STRUCT_BYTES = _GUID_BYTES + 8
_POINTER_OFFSET = object.__basicsize__
_POINTER_BYTES = ctypes.sizeof(ctypes.c_void_p)

UNKNOWN_CLIENT = bytes(_GUID_BYTES)
"""Stands for every client when rmw's guid cannot be read."""


def read_writer_guid(request_id: Any) -> bytes | None:
    """Return the 16 bytes of rmw's writer guid, or None when this build of rclpy keeps them elsewhere."""
    exposed = getattr(request_id, "writer_guid", None)
    if exposed is not None:
        return bytes(exposed)
    if type(request_id).__basicsize__ < _POINTER_OFFSET + _POINTER_BYTES:
        return None
    pointer = ctypes.c_void_p.from_address(id(request_id) + _POINTER_OFFSET).value
    if not pointer:
        return None
    raw = ctypes.string_at(pointer, _STRUCT_BYTES)
    sequence_number = int.from_bytes(raw[_GUID_BYTES:], sys.byteorder, signed=True)
    return raw[:_GUID_BYTES] if sequence_number == request_id.sequence_number else None


class RequestNumbering:
    """Names each request and its client.

    Fast DDS makes its guids of host, process number and 16 random bits, so a client that is restarted for ever in a
    container may meet one of its own old ones. The number of arrival in this session goes into the name as well: with
    it no name can come twice, and where rmw's guid cannot be read it is enough by itself.
    """

    __slots__ = ("_arrivals", "_session", "guid_is_readable")

    def __init__(self, session: SessionId) -> None:
        self._session = session
        self._arrivals = 0
        self.guid_is_readable = True

    def identify(self, request_id: Any) -> tuple[RequestId, bytes]:
        """Return (id of the request, guid of its client); of two requests never the same id."""
        guid = read_writer_guid(request_id) if self.guid_is_readable else None
        if guid is None:
            self.guid_is_readable = False
            guid = UNKNOWN_CLIENT
        self._arrivals += 1
        identity = guid + self._arrivals.to_bytes(8, "big")
        return make_request_id(self._session, identity, request_id.sequence_number), guid
