"""Finds services that the configuration names but that are not available.

Either nobody serves them, most often because the name is wrong, or a robot reaches none of the servers that it knows.
"""

from __future__ import annotations

import difflib
from typing import TYPE_CHECKING

from plr.protos.model.ids import ServiceName
from plr.sidecar.config.fields import is_glob

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Mapping


GRACE_S = 15.0
"""Time after the start that servers, their discovery and the control plane take, even on a slow machine."""
MAX_NAMES_SHOWN = 10


class UnmetServices:
    """Tracks the names, not the globs, of the configuration. Pure: the time is passed in (s)."""

    def __init__(self, patterns: Iterable[str], now: float) -> None:
        self._names = tuple(pattern for pattern in patterns if not is_glob(pattern))
        self._judged_from = now + GRACE_S
        self._told: set[str] = set()
        self.unmet: frozenset[str] = frozenset()
        """Services that nobody served at the last look."""
        self.unreached: Mapping[str, int] = {}
        """Services of which no server was reached at the last look, with the number of servers known."""
        self._coming: frozenset[str] = frozenset()
        """Services that somebody served at the last look, perhaps only just."""

    def look(
        self,
        met: Collection[ServiceName],
        unreached: Mapping[ServiceName, int],
        now: float,
        coming: Iterable[ServiceName] = (),
    ) -> list[str]:
        """Note which services are served now; return those never seen served, each once, when it is time to report.

        `unreached` counts the known servers of others that are not reached. `coming` lists services that somebody
        serves, whether or not they are available: that takes a moment.
        """
        before, self._coming = self._coming, frozenset(coming)
        if now < self._judged_from:
            self._told.update(name for name in self._names if name in met)
            return []
        lacking = [name for name in self._names if name not in met]
        self.unreached = {name: servers for name in lacking if (servers := unreached.get(ServiceName(name), 0))}
        self.unmet = frozenset(name for name in lacking if name not in self.unreached)
        self._told.update(name for name in self._names if name in met)
        just_come = self._coming - before
        news = [name for name in self._names if name not in self._told and name not in just_come]
        self._told.update(news)
        return news


def told_unreached(name: str, servers: int) -> str:
    """Return a line about a name of which a robot knows this many servers, and reaches none."""
    return f"service {name} is offered by {servers} servers that this robot knows, but it reaches none of them"


def told_mismatched(name: str) -> str:
    """Return a line about a name whose server on a cloud's host cannot be called."""
    whose = "a node of this host's ROS domain"
    return f"service {name} is served by {whose}, with an incompatible QoS: make it reliable, which is the default"


def told(name: str, offered: Iterable[str], whose: str) -> str:
    """Return a line about a name that is not served; `offered` are the names that are, `whose` says by whom."""
    names = sorted(set(offered))
    if name in names:
        return f"service {name} is configured and offered, but no server of it is reached, or none has the wanted type"
    close = difflib.get_close_matches(name, names, n=1)
    if close:
        return f"service {name} is configured, but {whose} offers it; did you mean {close[0]}?"
    shown = " ".join(names[:MAX_NAMES_SHOWN]) + (f" and {len(names) - MAX_NAMES_SHOWN} more" if names[10:] else "")
    return f"service {name} is configured, but {whose} offers it; offered: {shown or 'nothing'}"
