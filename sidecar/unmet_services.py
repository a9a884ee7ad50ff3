"""Which services the configuration names and nobody serves: most often the name is wrong."""

from __future__ import annotations

import difflib
from typing import TYPE_CHECKING

from sidecar.config_fields import is_glob

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable

    from protos.model import ServiceName

GRACE_S = 15.0
"""After the start: what servers, their discovery and the control plane take, also on a slow machine."""
MAX_NAMES_SHOWN = 10


class UnmetServices:
    """Follows the names, not the globs, of the configuration. Pure: the time is given (s)."""

    def __init__(self, patterns: Iterable[str], now: float) -> None:
        self._names = tuple(pattern for pattern in patterns if not is_glob(pattern))
        self._judged_from = now + GRACE_S
        self._told: set[str] = set()
        self.unmet: frozenset[str] = frozenset()
        """Those that nobody served at the last look."""

    def look(self, met: Collection[ServiceName], now: float) -> list[str]:
        """Note which are served now; return those never seen served, each once, when it is time to tell of them."""
        if now < self._judged_from:
            self._told.update(name for name in self._names if name in met)
            return []
        self.unmet = frozenset(name for name in self._names if name not in met)
        self._told.update(name for name in self._names if name in met)
        news = [name for name in self._names if name not in self._told]
        self._told.update(news)
        return news


def told(name: str, offered: Iterable[str], whose: str) -> str:
    """Return a line about a name that is not served; `offered` are the names that are, `whose` says by whom."""
    names = sorted(set(offered))
    if name in names:
        return f"service {name} is configured and offered, and no server of it is reached: plr doctor says more"
    close = difflib.get_close_matches(name, names, n=1)
    if close:
        return f"service {name} is configured, and {whose} offers it; did you mean {close[0]}?"
    shown = " ".join(names[:MAX_NAMES_SHOWN]) + (f" and {len(names) - MAX_NAMES_SHOWN} more" if names[10:] else "")
    return f"service {name} is configured, and {whose} offers it; offered: {shown or 'nothing'}"
