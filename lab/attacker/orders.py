"""Decides when a compromised member of the fleet is honest, by a file beside its configuration.

The harness writes and removes that file.
"""

from __future__ import annotations

import enum
import json
import threading
import time
from dataclasses import asdict, dataclass
from fnmatch import fnmatchcase as fnmatch
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pathlib import Path

ORDERS, TALLY = ".orders", ".tally"
"""Suffixes of the files beside the configuration."""
LOOK_EVERY_S = 0.2
LAST_STAGES = 0.65
"""Share of a cycle: until then come the attacks that a session survives; then those that end it, ..."""
ACKNOWLEDGING = 0.71
"""... beginning with spoofed sources, then acknowledgements of what nobody sent, which a peer tolerates once, ..."""
LAST_STAGE = 0.75
"""... and then new sessions, which make the peers forget it."""


class Stage(enum.Enum):
    """The stage of an insider's cycle."""

    HONEST = enum.auto()
    STEADY = enum.auto()
    """All attacks at once that its peers tolerate without ending the session."""
    SPOOFING = enum.auto()
    """Spoofed sources as well."""
    ACKNOWLEDGING = enum.auto()
    """Blind acknowledgements, which end the session at the receiver."""
    RESTARTING = enum.auto()
    """A new session every second."""
    OVER = enum.auto()
    """The program restarts."""


@dataclass(frozen=True, slots=True)
class Orders:
    """The content of the file."""

    cycle_s: float
    """Time from one restart of the program to the next."""
    third_party: tuple[str, str]
    """IPv4 and IPv6 address of an uninvolved host."""
    names: tuple[str, ...] = ()
    """Names of honest nodes."""
    only: tuple[str, ...] = ("*",)
    """Patterns (fnmatch) of attack names; no others are run."""

    def want(self, attack: str) -> bool:
        """Return whether this attack is to be run."""
        return any(fnmatch(attack, pattern) for pattern in self.only)

    def write(self, file: Path) -> None:
        """Write the file, so that the attacks begin; without it there are none."""
        file.write_text(json.dumps(asdict(self)))


class Commander:
    """Follows the file."""

    def __init__(self, file: Path, later: float = 1.0) -> None:
        """Follow `file`; `later` is the ratio of this cycle to the ordered one: two insiders must not keep step."""
        self.orders: Orders | None = None
        self._file = file
        self._later = later
        self._since = 0.0
        threading.Thread(target=self._watch, name="orders", daemon=True).start()

    @property
    def stage(self) -> Stage:
        """The current stage of the cycle."""
        orders = self.orders
        if orders is None:
            return Stage.HONEST
        gone = (time.monotonic() - self._since) / (orders.cycle_s * self._later)
        if gone < LAST_STAGES:
            return Stage.STEADY
        if gone < LAST_STAGE:
            return Stage.SPOOFING if gone < ACKNOWLEDGING else Stage.ACKNOWLEDGING
        return Stage.RESTARTING if gone < 1.0 else Stage.OVER

    def want(self, attack: str) -> bool:
        """Return whether an attack is to be run now."""
        orders = self.orders
        return orders is not None and orders.want(attack)

    def _watch(self) -> None:
        while True:
            try:
                said = json.loads(self._file.read_text())
            except (OSError, ValueError):  # there is no file, or it is being written
                self.orders = None
            else:
                if self.orders is None:
                    self._since = time.monotonic()
                third_party, names, only = (tuple(said[key]) for key in ("third_party", "names", "only"))
                self.orders = Orders(said["cycle_s"], third_party, names, only)
            time.sleep(LOOK_EVERY_S)
