"""Logs what is refused from the control plane, which sends it again until it is accepted."""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from plr.protos.model.stream import ResourceKind


class RefusalLog:
    """Logs what is refused and why: once, until the reason changes or something of that resource is accepted."""

    def __init__(self, log: logging.Logger) -> None:
        self._log = log
        self._told: dict[ResourceKind, str] = {}

    def refused(self, resource: ResourceKind | None, what: str, error: str, failure: Exception | None = None) -> None:
        """Log a refusal; `resource` is None if unknown, and `failure` is an internal failure behind it."""
        level = logging.WARNING if failure is None else logging.ERROR
        if resource is not None:
            if self._told.get(resource) == error:
                level = logging.DEBUG
            self._told[resource] = error
        self._log.log(level, "refused %s: %s", what, error, exc_info=failure)

    def taken(self, resource: ResourceKind) -> None:
        """Note an acceptance: the next refusal is news again."""
        self._told.pop(resource, None)
