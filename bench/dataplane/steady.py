"""Keeps the machine's other work and its sleep out of figures in milliseconds, for all contenders alike."""

from __future__ import annotations

import contextlib
import os
import struct
import subprocess
from functools import lru_cache
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterator

_LATENCY_REQUEST = "/dev/cpu_dma_latency"
_REALTIME = ("chrt", "--rr", "1")


@lru_cache(maxsize=1)
def realtime() -> tuple[str, ...]:
    """Return the command that starts a program as `deploy/systemd/realtime.conf` does; empty if that is not allowed."""
    try:
        allowed = subprocess.run([*_REALTIME, "true"], check=False, capture_output=True).returncode == 0
    except OSError:
        allowed = False
    return _REALTIME if allowed else ()


@contextlib.contextmanager
def awake() -> Iterator[bool]:
    """Keep the processors from sleeping deeply, as cyclictest does; yield whether the kernel lets us.

    Waking from sleep costs a physical machine some ten microseconds, a nested virtual one some hundred.
    """
    try:
        request = os.open(_LATENCY_REQUEST, os.O_WRONLY)
    except OSError:
        yield False
        return
    try:
        os.write(request, struct.pack("=i", 0))
        yield True
    finally:
        os.close(request)
