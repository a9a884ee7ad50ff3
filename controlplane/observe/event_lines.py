"""Encodes an event as a line of JSON, for the control plane's file and `plr events --json`."""

from __future__ import annotations

import json
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any, TypeVar

from plr.protos.base.errors import DecodeError
from plr.protos.model.fleet_events import EventKind, FleetEvent, Why
from plr.protos.model.ids import Role
from plr.protos.model.names import clean_text, node_name

if TYPE_CHECKING:
    import enum

MAX_EVENT_LINE_BYTES = 4096
"""A longer line is damaged: a text has at most 255 bytes."""

MAX_EVENT_NUMBER = 1 << 62

E = TypeVar("E", bound="enum.Enum")


def encode(event: FleetEvent) -> str:
    """Return the line without its line end."""
    shown: dict[str, Any] = {"number": event.number, "at": timestamp(event.at), "kind": event.kind.value}
    if event.node is not None:
        shown["node"] = event.node
    if event.role is not None:
        shown["role"] = event.role.value
    if event.why is not None:
        shown["why"] = event.why.value
    if event.seen_at is not None:
        shown["seen"] = timestamp(event.seen_at)
    if event.text:
        shown["text"] = event.text
    return json.dumps(shown, ensure_ascii=False)


def decode(line: bytes) -> FleetEvent:
    """Parse a line; raises DecodeError if it is not one of ours, or damaged."""
    if len(line) > MAX_EVENT_LINE_BYTES:
        raise DecodeError("the line is too long")
    try:
        shown = json.loads(line)
    except (ValueError, RecursionError) as error:
        raise DecodeError("expected JSON") from error
    if not isinstance(shown, dict):
        raise DecodeError("expected a JSON object")
    number = shown.get("number")
    if type(number) is not int or not 0 < number < MAX_EVENT_NUMBER:
        raise DecodeError("expected a number")
    kind = _member(EventKind, shown, "kind")
    if kind is None:
        raise DecodeError("expected a kind")
    node = shown.get("node")
    text = shown.get("text", "")
    if not isinstance(text, str) or clean_text(text) != text:
        raise DecodeError("expected printable text")
    return FleetEvent(
        number=number,
        at=_seconds(shown.get("at")),
        kind=kind,
        node=node_name(node, "node") if isinstance(node, str) else None,
        text=text,
        role=_member(Role, shown, "role"),
        why=_member(Why, shown, "why"),
        seen_at=_seconds(shown["seen"]) if shown.get("seen") is not None else None,
    )


def timestamp(at: float) -> str:
    """Return seconds since 1970 as a UTC timestamp that people and programs can read."""
    return datetime.fromtimestamp(at, UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")


def _seconds(text: object) -> float:
    if not isinstance(text, str):
        raise DecodeError("expected a time")
    try:
        at = datetime.fromisoformat(text)
        if at.tzinfo is None:
            raise DecodeError("expected a time with its zone")
        return at.timestamp()
    except (ValueError, OverflowError) as error:
        raise DecodeError("expected a time") from error


def _member(kind: type[E], shown: dict[str, Any], field: str) -> E | None:
    value = shown.get(field)
    if value is None:
        return None
    try:
        return kind(value)
    except ValueError as error:
        raise DecodeError(f"{field} has no meaning for {value!a}") from error
