"""Derives the CDR layout of a generated message class from the type description that it carries."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from rosidl_parser.definition import (
    Array,
    BasicType,
    BoundedSequence,
    BoundedString,
    NamespacedType,
    UnboundedSequence,
    UnboundedString,
)

from plr.sidecar.ros import cdr_walk

if TYPE_CHECKING:
    from plr.sidecar.ros.cdr_walk import Layout

_BYTES = {
    **dict.fromkeys(("boolean", "octet", "char", "int8", "uint8"), 1),
    **dict.fromkeys(("int16", "uint16"), 2),
    **dict.fromkeys(("int32", "uint32", "float"), 4),
    **dict.fromkeys(("int64", "uint64", "double"), 8),
}
MAX_DEPTH = 64
"""Nesting depth of messages within messages."""


class _UnknownLayoutError(Exception):
    """A field whose encoding this module does not know."""


def layout_of(message_class: Any) -> Layout | None:
    """Return the layout of a message class, or None if it has wide characters or long doubles.

    Implementations encode those differently.
    """
    try:
        return _structure(message_class, 0)
    except _UnknownLayoutError:
        return None


def _structure(message_class: Any, depth: int) -> Layout:
    if depth > MAX_DEPTH:
        raise _UnknownLayoutError
    return cdr_walk.structure([_layout(slot, depth) for slot in message_class.SLOT_TYPES])


def _layout(slot: Any, depth: int) -> Layout:
    match slot:
        case BasicType(typename=name) if name in _BYTES:
            return cdr_walk.primitive(_BYTES[name])
        case BoundedString():
            return cdr_walk.String(slot.maximum_size)
        case UnboundedString():
            return cdr_walk.String()
        case BoundedSequence():
            return cdr_walk.Elements(_layout(slot.value_type, depth), slot.maximum_size)
        case UnboundedSequence():
            return cdr_walk.Elements(_layout(slot.value_type, depth))
        case Array():
            return cdr_walk.array(_layout(slot.value_type, depth), slot.size)
        case NamespacedType():
            module = importlib.import_module(".".join(slot.namespaces))
            return _structure(getattr(module, slot.name), depth + 1)
        case _:
            raise _UnknownLayoutError
