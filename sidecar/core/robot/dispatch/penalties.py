"""Robot side: puts servers whose answers could not be delivered out of favour, and asks others in their place.

A faulty or hostile server answers fast and wins the races that it then spoils. So it is out of favour for a time that
doubles with each bad answer; its bad answers are forgotten with a half-life. Meanwhile it is asked only where no other
server offers the service.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

from plr.protos.model.report import PenaltyReport

if TYPE_CHECKING:
    from collections.abc import Iterable

    from plr.protos.model.ids import NodeName

FIRST_S = 10.0
"""Time out of favour after the first bad answer ..."""
LONGEST_S = 600.0
"""... and at most."""
_MOST_DOUBLINGS = math.log2(LONGEST_S / FIRST_S)
"""Caps the exponent: thousands of bad answers may come at once, and two to that power overflows a float."""
HALF_LIFE_S = 120.0
"""Half-life of a server's bad answers."""
FORGOTTEN_BELOW = 0.1
"""Level of bad answers below which a server is forgotten: reached seven minutes after a single bad answer."""
MAX_SERVERS = 1024
"""Servers remembered; beyond that the one that is back in favour first is forgotten."""


@dataclass(slots=True)
class _Record:
    level: float
    """Number of bad answers, each worth half after HALF_LIFE_S."""
    updated_at: float
    until: float

    def now(self, now: float) -> float:
        return self.level * math.pow(2.0, (self.updated_at - now) / HALF_LIFE_S)


class Penalties:
    """Penalties by server, whatever the service: a server that spoils one is not trusted with another."""

    __slots__ = ("_records",)

    def __init__(self) -> None:
        self._records: dict[NodeName, _Record] = {}

    def bad_answer(self, server: NodeName, now: float) -> float:
        """Note an answer that could not be delivered; return for how many seconds its server is out of favour."""
        record = self._records.pop(server, None)
        level = 1.0 + (0.0 if record is None else record.now(now))
        out_s = min(FIRST_S * math.pow(2.0, min(level - 1.0, _MOST_DOUBLINGS)), LONGEST_S)
        self._forget(now)
        self._records[server] = _Record(level, now, now + out_s)
        return out_s

    def _forget(self, now: float) -> None:
        """Forget servers below FORGOTTEN_BELOW, and one if too many remain; called at a bad answer, which is rare."""
        for server in [name for name, record in self._records.items() if record.now(now) < FORGOTTEN_BELOW]:
            del self._records[server]
        if len(self._records) >= MAX_SERVERS:
            del self._records[min(self._records, key=lambda name: self._records[name].until)]

    def out_until(self, server: NodeName) -> float:
        """Return when it is back in favour; a time in the past if it is."""
        record = self._records.get(server)
        return -math.inf if record is None else record.until

    def report(self, now: float) -> tuple[PenaltyReport, ...]:
        """Return the servers that are out of favour, for the control plane."""
        return tuple(
            PenaltyReport(server, record.until - now, math.ceil(record.now(now)))
            for server, record in self._records.items()
            if record.until > now
        )

    def favoured(self, servers: Iterable[NodeName], now: float) -> tuple[NodeName, ...]:
        """Return the servers that are in favour, or all if none is."""
        every = tuple(servers)
        if not self._records:
            return every
        return tuple(server for server in every if self.out_until(server) <= now) or every
