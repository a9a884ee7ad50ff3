"""How urgent a service is: what is more urgent goes first, whatever the deadlines."""

from __future__ import annotations

import enum


class Priority(enum.IntEnum):
    """Smaller is more urgent, so that queues sort by it; the numbers stand on the wire."""

    HIGH = 0
    NORMAL = 1
    LOW = 2
