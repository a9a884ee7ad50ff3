"""Limits the events about refused sidecars: one that is refused tries again for ever, and one without a certificate (in
insecure mode) may call itself anything."""

from __future__ import annotations

import math
from collections import OrderedDict
from dataclasses import dataclass

from plr.protos.base.token_bucket import TokenBucket

TELL_AGAIN_S = 60.0
"""Least time between two events about one name that is refused for the same reason."""

REFUSALS_BURST = 64.0
"""Such events of all names that are taken at once: those of a fleet whose sidecars are all refused tell nothing new."""

REFUSALS_PER_S = 0.2
"""Rate after that; each event is written to the disk."""

MAX_REFUSED_NAMES = 4096
"""Pairs of a name and a reason that are remembered; the one told longest ago is forgotten."""


@dataclass(slots=True)
class _Refused:
    told_at: float = -math.inf
    left_out: int = 0
    """Refusals left out since the last event."""


class RefusalShare:
    """Counts refusals. Times are monotonic seconds."""

    def __init__(self) -> None:
        self._of: OrderedDict[tuple[str, str], _Refused] = OrderedDict()
        self._all = TokenBucket(rate=REFUSALS_PER_S, burst=REFUSALS_BURST, now=0.0)
        self.left_out = 0
        """Refusals left out, of all names."""

    def __len__(self) -> int:
        """Return how many pairs of a name and a reason are remembered."""
        return len(self._of)

    def take(self, name: str, reason: str, now: float) -> int | None:
        """Return how many refusals of this name for this reason were left out since the last event; None: leave out
        this one too."""
        key = (name, reason)
        refused = self._of.get(key)
        if refused is None:
            refused = self._of[key] = _Refused()
            if len(self._of) > MAX_REFUSED_NAMES:
                self._of.popitem(last=False)
        # One beyond its own share takes nothing of that of all.
        if now - refused.told_at >= TELL_AGAIN_S and self._all.take(now):
            self._of.move_to_end(key)
            left_out, refused.left_out = refused.left_out, 0
            refused.told_at = now
            return left_out
        refused.left_out += 1
        self.left_out += 1
        return None
