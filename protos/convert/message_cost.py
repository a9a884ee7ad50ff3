"""Checks from the bytes of a sidecar's message what parsing it would cost, before it is parsed.

Two bytes can be an element of a list, which takes a hundred bytes once parsed: 4 MiB of them hold up a program for
seconds and fill its memory. So the fields are counted first.
"""

from __future__ import annotations

from plr.protos.base.errors import DecodeError
from plr.protos.convert.fields import MAX_CANDIDATES, MAX_OFFERS, MAX_OUTCOMES, MAX_USES
from plr.protos.model.members import MAX_UNMET
from plr.protos.model.report import MAX_GOODBYES, MAX_JOINTS, MAX_LATENCIES, MAX_PATH_REPORTS, MAX_PENALTIES
from plr.protos.plr.v1 import control_pb2
from plr.protos.trust.identity import MAX_CA_CERTIFICATES

CHEAP_BYTES = 4096
"""A message no longer than this is cheap whatever it holds."""

SPARE_FIELDS = 1024
"""Room for single fields, and for those of a newer sidecar."""

_NAMES = {field.number: field.name for field in control_pb2.SidecarMessage.DESCRIPTOR.fields}

_ELEMENTS = {
    "candidates": 3 * MAX_CANDIDATES,
    "services": MAX_OFFERS + MAX_USES + 3 * MAX_UNMET,
    "report": MAX_LATENCIES + MAX_PATH_REPORTS + MAX_OUTCOMES + 2 * MAX_JOINTS + MAX_PENALTIES + MAX_GOODBYES,
    "revocations": MAX_CA_CERTIFICATES,
}
"""Most elements in all lists of a message of this kind; other kinds have none."""

_MALFORMED = "not a SidecarMessage: its fields do not fit its length"


def check_cost(data: bytes) -> None:
    """Raise DecodeError if these bytes hold more than a sidecar's message can, or if they are cut short."""
    if len(data) <= CHEAP_BYTES:
        return
    at, fields, kind = 0, 0, None
    while at < len(data):
        number, begin, at = _field(data, at, len(data))
        fields += 1
        if fields > SPARE_FIELDS:
            raise DecodeError(f"a message has more than {SPARE_FIELDS} fields")
        name = _NAMES.get(number)
        if name is None:
            continue
        if kind is not None:
            raise DecodeError(f"a message is of two kinds, {kind} and {name}")
        kind = name
        _count(data, begin, at, name)


def _count(data: bytes, at: int, end: int, kind: str) -> None:
    most = _ELEMENTS.get(kind, 0) + SPARE_FIELDS
    fields = 0
    while at < end:
        _, _, at = _field(data, at, end)
        fields += 1
        if fields > most:
            raise DecodeError(f"{kind} has more than {most} elements")


def _field(data: bytes, at: int, end: int) -> tuple[int, int, int]:
    """Return the number of the field that begins here, where its content begins, and where it ends."""
    tag, at = _varint(data, at, end)
    match tag & 7:
        case 0:
            begin, (_, stop) = at, _varint(data, at, end)
        case 1:
            begin, stop = at, at + 8
        case 2:
            size, begin = _varint(data, at, end)
            stop = begin + size
        case 5:
            begin, stop = at, at + 4
        case _:
            # Groups, which no version uses.
            raise DecodeError(_MALFORMED)
    if stop > end:
        raise DecodeError(_MALFORMED)
    return tag >> 3, begin, stop


def _varint(data: bytes, at: int, end: int) -> tuple[int, int]:
    """Return the number that begins here, and where it ends."""
    value = shift = 0
    while at < end and shift < 70:
        byte = data[at]
        at += 1
        value |= (byte & 0x7F) << shift
        if byte < 0x80:
            return value, at
        shift += 7
    raise DecodeError(_MALFORMED)
