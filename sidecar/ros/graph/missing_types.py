"""Checks before the start whether the types of configured services, as far as known, are installed here.

A configuration need not name types. The sidecar's `state_dir` holds what servers offered when it last ran.
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
    """Return a line for each service whose type is missing here: the type in `rules`, or the one that `peers` offer.

    There are at most MAX_MISSING_TYPE_LINES, and one that counts the rest.
    """
    rules = tuple(rules)
    carried = Rules(rules)
    servers = {
        (offer.name, offer.type): peer.name
        for peer in peers
        for offer in peer.offers
        if carried.find(offer.name) is not None
    }
    problems: dict[str, str | None] = {}

    def problem_of(kind: str) -> str | None:
        if kind not in problems:
            problems[kind] = _problem(kind)
        return problems[kind]

    lines = [
        f"{rule.pattern} cannot be carried with the type that the configuration names: {problem}"
        for rule in rules
        if rule.type and (problem := problem_of(rule.type)) is not None
    ]
    for (name, kind), server in sorted(servers.items()):
        rule = carried.find(name)
        if rule is not None and rule.type:
            continue  # another type gets no requests anyway
        if (problem := problem_of(kind)) is not None:
            lines.append(f"{name}, which {server} offered last, cannot be carried: {problem}")
    left_out = len(lines) - MAX_MISSING_TYPE_LINES
    return [*lines[:MAX_MISSING_TYPE_LINES], f"and {left_out} more"] if left_out > 0 else lines


def _problem(kind: str) -> str | None:
    try:
        load_service_type(kind)
    except RosBridgeError as error:
        return str(error)
    return None
