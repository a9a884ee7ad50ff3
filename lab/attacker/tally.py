"""Counts runs, messages and bytes of an attacker, by attack, in a file that survives its restarts."""

from __future__ import annotations

import json
import threading
from typing import TYPE_CHECKING

from plr.controlplane.ca.files import write_atomically

if TYPE_CHECKING:
    from pathlib import Path


class Tally:
    """Counts of one program; any thread may add to them."""

    def __init__(self, file: Path) -> None:
        self._file = file
        self._lock = threading.Lock()
        self._counts: dict[str, list[int]] = json.loads(file.read_text()) if file.exists() else {}

    def add(self, attack: str, messages: int = 1, size: int = 0) -> None:
        """Count one run of an attack, its messages and their total bytes."""
        with self._lock:
            counts = self._counts.setdefault(attack, [0, 0, 0])
            counts[0] += 1
            counts[1] += messages
            counts[2] += size

    def write(self) -> None:
        """Replace the file."""
        with self._lock:
            content = json.dumps(self._counts)
        write_atomically(self._file, content.encode(), 0o644)
