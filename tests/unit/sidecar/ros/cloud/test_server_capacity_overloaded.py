"""A server that is asked for more than it can do works for those who still wait for it."""

from __future__ import annotations

import pytest

from tests.unit.sidecar.ros.server_model import ModelServer

WAITING = 64
LIFETIME_S = 30.0
SECONDS = 200.0


@pytest.mark.audit("dp-13")
@pytest.mark.parametrize("variation", [0.0, 0.5])
def test_what_expires_in_work_does_not_keep_the_server_from_the_rest(variation: float) -> None:
    """One second for each request, and always 64 wait: the oldest is half a minute old, which is its lifetime."""
    server = ModelServer(lambda rng: rng.gammavariate(1 / variation**2, variation**2) if variation else 1.0, now=0.0)
    useful = 0.0
    while server.now < SECONDS:
        server.ask(WAITING - server.window.waiting, deadline_s=1.0, lifetime_s=LIFETIME_S)
        server.run(0.05)
        useful = len(server.answered.keys() - server.expired)
    # It does about one a second; the last ones are still in work.
    assert useful >= 0.9 * SECONDS
