"""Logs the loss of the control plane, which is retried forever."""

from __future__ import annotations

import math
import re
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import logging

REPEATED_FAILURE_LOG_S = 60.0
"""An outage is logged when it starts or its reason changes, and this often while it lasts."""
_AGE = re.compile(r"[0-9]+ (?=seconds|minutes|hours|days)")
"""Ages are ignored: a certificate that has been expired for one more second is no new reason."""


class OutageLog:
    """Logs when the control plane is lost and found, without a line for every attempt in between."""

    def __init__(self, log: logging.Logger, target: str) -> None:
        self._log = log
        self._target = target
        self._attempts = 0
        self._logged_at = -math.inf
        self._kind = ""

    def failed(self, reason: str, delay_s: float, now: float, *, was_connected: bool) -> None:
        """Note that an attempt failed or a stream ended at `now`; the next attempt follows in `delay_s`."""
        self._attempts = 1 if was_connected else self._attempts + 1
        quiet = now - self._logged_at < REPEATED_FAILURE_LOG_S and self._attempts > 1
        kind = _AGE.sub("", reason)
        if quiet and kind == self._kind:
            write = self._log.debug
        else:
            write = self._log.warning
            self._logged_at = now
            self._kind = kind
        what = "lost" if was_connected else "not reached"
        write(
            "control plane %s %s: %s; the sidecar continues without it, attempt %d in %.1f s",
            self._target,
            what,
            reason,
            self._attempts + 1,
            delay_s,
        )

    def over(self, where: str) -> None:
        """Note that the control plane answered at `where`."""
        self._log.info("registered with the control plane %s", where)
        self._attempts = 0
        self._kind = ""
