"""Defines the protocol of a sidecar's local socket: a request is one line of JSON, its answer one or more. Pure. ::

{"id": 1, "ask": "state"}                                        the sidecar's state
{"id": 2, "ask": "ping", "peer": "cloud-1", "interface": "wlan0", "size": 64}     a ping over each path to a peer

{"id": 1, "part": "paths", "value": ...}      a piece of the answer; paths, interfaces, mapped and ways come repeatedly
{"id": 2, "part": "pinged", "value": [...]}   the paths over which it is sent; then for each that is answered:
{"id": 2, "part": "pong", "value": {"interface": ..., "remote": ..., "rtt_s": ..., "problem": ...}}
{"id": 1, "end": true}                        the answer is complete
{"id": 1, "error": "...", "busy": true}       the request is refused; busy: it may succeed later
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import Any

from plr.protos.base.errors import DecodeError
from plr.protos.model.names import node_name
from plr.sidecar.core.wire.frame import MAX_DATAGRAM_BYTES

VERSION = 1
"""Version in the part `node`. A client has to ignore parts and keys that it does not know."""
MAX_REQUEST_LINE_BYTES = 1024
"""Longest line, including its end."""
MAX_REQUESTS_OF_CONNECTION = 8
"""Most requests of one connection being answered."""
MAX_ID = 1 << 32
_MAX_INTERFACE_CHARACTERS = 15


@dataclass(frozen=True, slots=True)
class StateRequest:
    """Asks for the sidecar's state."""

    id: int


@dataclass(frozen=True, slots=True)
class PingRequest:
    """Asks for one ping over each path to a peer."""

    id: int
    peer: str
    interface: str | None
    """The only interface to use; None: all."""
    size: int
    """Bytes of UDP payload; raised where a probe does not fit."""


def decode_request(line: bytes) -> StateRequest | PingRequest:
    """Parse one request line; raises DecodeError."""
    if len(line) > MAX_REQUEST_LINE_BYTES:
        raise DecodeError(f"a request has at most {MAX_REQUEST_LINE_BYTES} bytes")
    try:
        request = json.loads(line)
    except (ValueError, RecursionError):
        raise DecodeError("a request must be one line of JSON") from None
    if not isinstance(request, dict):
        raise DecodeError("a request must be an object")
    request_id = _whole(request, "id", 0, MAX_ID)
    match request.get("ask"):
        case "state":
            return StateRequest(request_id)
        case "ping":
            return PingRequest(
                request_id, _peer(request), _interface(request), _whole(request, "size", 0, MAX_DATAGRAM_BYTES)
            )
    raise DecodeError("ask must be state or ping")


def _whole(request: dict[str, Any], key: str, least: int, most: int) -> int:
    value = request.get(key)
    if type(value) is not int or not least <= value <= most:
        raise DecodeError(f"{key} must be a whole number from {least} to {most}")
    return value


def _peer(request: dict[str, Any]) -> str:
    value = request.get("peer")
    if not isinstance(value, str):
        raise DecodeError("peer must be a node's name")
    return node_name(value, "peer")


def _interface(request: dict[str, Any]) -> str | None:
    value = request.get("interface")
    if value is None:
        return None
    if not isinstance(value, str) or not 0 < len(value) <= _MAX_INTERFACE_CHARACTERS:
        raise DecodeError("interface must be an interface's name")
    return value


def encode_part(request_id: int, part: str, value: object) -> bytes:
    """Return a line with a piece of an answer."""
    return _line({"id": request_id, "part": part, "value": value})


def encode_end(request_id: int) -> bytes:
    """Return the line that ends an answer."""
    return _line({"id": request_id, "end": True})


def encode_error(request_id: int | None, text: str, *, busy: bool = False) -> bytes:
    """Return the line that refuses a request, or without id any request. `busy`: it may be asked again later."""
    value: dict[str, object] = {"id": request_id, "error": text}
    if busy:
        value["busy"] = True
    return _line(value)


def _line(value: dict[str, object]) -> bytes:
    return json.dumps(value, allow_nan=False, separators=(",", ":")).encode() + b"\n"
