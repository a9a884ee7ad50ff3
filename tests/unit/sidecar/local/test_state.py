from __future__ import annotations

import pytest

from plr.protos.model.members import RemovalReason
from plr.sidecar.core.engine.engine import RemovedPeerView
from plr.sidecar.core.engine.removals import Removal
from plr.sidecar.local.state import _removed
from tests.support.builders import A


@pytest.mark.parametrize(
    ("kept", "dormant_s", "heard"), [("dormant", 60.0, True), ("path", None, False), (None, None, False)]
)
def test_a_removed_peer_says_since_when_it_is_dormant_if_it_is(
    kept: str | None, dormant_s: float | None, heard: bool
) -> None:
    told = _removed(RemovedPeerView(A, Removal(RemovalReason.LEASE_EXPIRED, 10.0, 40.0), kept), 100.0, {A})
    assert told == {
        "name": A, "reason": "lease_expired", "since_s": 90.0, "kept": kept, "dormant_s": dormant_s, "heard": heard,
    }  # fmt: skip
    assert not _removed(RemovedPeerView(A, Removal(None, 10.0), kept), 100.0)["heard"]
