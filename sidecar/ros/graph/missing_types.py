"""Checks before the start whether the types of configured services, as far as known, are installed here.

A configuration names services, not types. The sidecar's `state_dir` holds what servers offered when it last ran.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from plr.sidecar.core.rules.service_rule import Rules
from plr.sidecar.ros.errors import RosBridgeError
from plr.sidecar.ros.types import load_service_type

if TYPE_CHECKING:
    from collections.abc import Iterable

    from plr.protos.model.members import Peer
    from plr.sidecar.core.rules.service_rule import ServiceRule

MAX_MISSING_TYPE_LINES = 10


def missing_types(peers: Iterable[Peer], rules: Iterable[ServiceRule]) -> list[str]:
    """Return a line for each service that `peers` offer and `rules` carry, but whose type is missing here.

    There are at most MAX_MISSING_TYPE_LINES, and one that counts the rest.
    """
    carried = Rules(rules)
    servers = {
        (offer.name, offer.type): peer.name
        for peer in peers
        for offer in peer.offers
        if carried.find(offer.name) is not None
    }
    problems: dict[str, str | None] = {}
    lines = []
    for (name, kind), server in sorted(servers.items()):
        if kind not in problems:
            problems[kind] = _problem(kind)
        if (problem := problems[kind]) is not None:
            lines.append(f"{name}, which {server} offered last, cannot be carried: {problem}")
    left_out = len(lines) - MAX_MISSING_TYPE_LINES
    return [*lines[:MAX_MISSING_TYPE_LINES], f"and {left_out} more"] if left_out > 0 else lines


def _problem(kind: str) -> str | None:
    try:
        load_service_type(kind)
    except RosBridgeError as error:
        return str(error)
    return None
