"""ROS domains leased to one test at a time, however many run in parallel on this machine."""

from __future__ import annotations

import contextlib
import fcntl
import os
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from collections.abc import Iterator

DOMAINS = range(1, 100)
"""Those whose UDP ports (7400 + 250 * domain and up) stay below Linux' ephemeral ports."""


@contextlib.contextmanager
def leased_domain() -> Iterator[int]:
    """A domain that no other test has until the block ends."""
    locks = Path(tempfile.gettempdir()) / f"plr-test-domains-{os.getuid()}"
    locks.mkdir(exist_ok=True)
    for domain in DOMAINS:
        with (locks / str(domain)).open("w") as lock:
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                continue
            yield domain
            return
    pytest.fail("every ROS domain is taken")
