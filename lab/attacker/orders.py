"""When a member of the fleet that somebody has taken over is honest, and when it is not: as a file beside its
configuration says, which the harness writes and removes."""

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
"""Of a cycle: until then everything that a session survives; then what ends it, ..."""
ACKNOWLEDGING = 0.71
"""... beginning with spoofed sources, then acknowledgements of what nobody sent, which a peer bears once, ..."""
LAST_STAGE = 0.75
"""... and then new sessions, which make the peers forget it."""


class Stage(enum.Enum):
    """Where an insider stands."""

    HONEST = enum.auto()
    STEADY = enum.auto()
    """Everything at once that its peers bear without ending the session."""
    SPOOFING = enum.auto()
    """Spoofed sources as well."""
    ACKNOWLEDGING = enum.auto()
    """Blind acknowledgements, which end the session at who gets them."""
    RESTARTING = enum.auto()
    """A new session every second."""
    OVER = enum.auto()
    """The program begins again."""


@dataclass(frozen=True, slots=True)
class Orders:
    """What the file says."""

    cycle_s: float
    """From one restart of the program to the next."""
    third_party: tuple[str, str]
    """An IPv4 and an IPv6 address at which somebody is who takes part in nothing."""
    names: tuple[str, ...] = ()
    """Honest nodes."""
    only: tuple[str, ...] = ("*",)
    """Patterns of the attacks' names (fnmatch): no others are run."""

    def want(self, attack: str) -> bool:
        """Whether this attack is to be run."""
        return any(fnmatch(attack, pattern) for pattern in self.only)

    def write(self, file: Path) -> None:
        """Let the attacks begin; without the file there are none."""
        file.write_text(json.dumps(asdict(self)))


class Commander:
    """Looks at the file."""

    def __init__(self, file: Path, later: float = 1.0) -> None:
        """`later`: by how much this one's cycle is longer than ordered, so that two of them do not keep step."""
        self.orders: Orders | None = None
        self._file = file
        self._later = later
        self._since = 0.0
        threading.Thread(target=self._watch, name="orders", daemon=True).start()

    @property
    def stage(self) -> Stage:
        """Where the cycle is now."""
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
        """Whether an attack is to be run now."""
        orders = self.orders
        return orders is not None and orders.want(attack)

    def _watch(self) -> None:
        while True:
            try:
                said = json.loads(self._file.read_text())
            except (OSError, ValueError):  # there is none, or it is being written
                self.orders = None
            else:
                if self.orders is None:
                    self._since = time.monotonic()
                third_party, names, only = (tuple(said[key]) for key in ("third_party", "names", "only"))
                self.orders = Orders(said["cycle_s"], third_party, names, only)
            time.sleep(LOOK_EVERY_S)
