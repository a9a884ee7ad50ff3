"""Finds the hosts of ROS_STATIC_PEERS that have no address now: rmw_fastrtps makes no node at all with one of them."""

from __future__ import annotations

import socket
import threading
import time
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

VARIABLE = "ROS_STATIC_PEERS"
PATIENCE_S = 5.0
"""For all names together; without a DNS server, one alone may take longer."""
MAX_PEERS = 64
"""Names looked up; rmw takes fewer."""


def unresolvable(
    environment: Mapping[str, str],
    resolve: Callable[[str], object] = lambda name: socket.getaddrinfo(name, None),
    patience_s: float = PATIENCE_S,
) -> tuple[str, ...]:
    """Return the peers that have no address, or none within `patience_s`."""
    names = list(dict.fromkeys(name for name in environment.get(VARIABLE, "").split(";") if name))[:MAX_PEERS]
    resolved: set[str] = set()

    def look_up(name: str) -> None:
        try:
            resolve(name)
        except (OSError, UnicodeError):
            return
        resolved.add(name)

    # Threads, as a look-up cannot be cut short; those that hang end by themselves.
    threads = [threading.Thread(target=look_up, args=(name,), name="plr-static-peer", daemon=True) for name in names]
    end = time.monotonic() + patience_s
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(max(0.0, end - time.monotonic()))
    found = set(resolved)
    return tuple(name for name in names if name not in found)


def without(environment: Mapping[str, str], names: tuple[str, ...]) -> dict[str, str]:
    """Return the environment without these peers."""
    kept = [name for name in environment.get(VARIABLE, "").split(";") if name and name not in names]
    return {**environment, VARIABLE: ";".join(kept)} if names else dict(environment)


def told(names: tuple[str, ...]) -> str:
    """Return one line on peers that are left out."""
    return (
        f"{VARIABLE}: {', '.join(names)} cannot be resolved and is left out; correct the name, or restart the sidecar "
        "when DNS knows it"
    )
