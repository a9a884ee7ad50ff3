"""What a ROS process says of its nodes, in CDR as rmw's type support writes it."""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

Node = tuple[str, str, "Sequence[bytes]", "Sequence[bytes]"]
"""Namespace, name, readers, writers."""


def endpoint(participant: int, number: int) -> bytes:
    """An endpoint's DDS id."""
    return b"\x01\x0f" + participant.to_bytes(10, "big") + number.to_bytes(4, "big")


def participant_info(participant: int, nodes: Iterable[Node], order: str = "<") -> bytes:
    """The message, with encapsulation."""
    nodes = tuple(nodes)
    body = bytearray(endpoint(participant, 0x1C1))

    def length(number: int) -> None:
        body.extend(bytes(-len(body) % 4) + struct.pack(order + "I", number))

    length(len(nodes))
    for namespace, name, *both in nodes:
        for text in (namespace, name):
            length(len(text) + 1)
            body.extend(text.encode() + b"\0")
        for ids in both:
            length(len(ids))
            body.extend(b"".join(ids))
    return (b"\0\1" if order == "<" else b"\0\0") + b"\0\0" + bytes(body)
