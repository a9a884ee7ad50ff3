"""What every kind of test may need."""

from __future__ import annotations

import fcntl
import os
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from collections.abc import Iterator

# Domains whose UDP ports (7400 + 250 * domain and up) stay below Linux' ephemeral ports.
ROS_DOMAINS = range(1, 100)


@pytest.fixture
def ros_domain() -> Iterator[int]:
    """A ROS domain that no other test on this machine has at the moment, however many run in parallel."""
    locks = Path(tempfile.gettempdir()) / f"plr-test-domains-{os.getuid()}"
    locks.mkdir(exist_ok=True)
    for domain in ROS_DOMAINS:
        with (locks / str(domain)).open("w") as lock:
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                continue
            yield domain
            return
    pytest.fail("every ROS domain is taken")
