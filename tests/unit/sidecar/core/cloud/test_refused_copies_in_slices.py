"""Copies that were refused in a burst are forgotten in slices."""

from __future__ import annotations

import pytest

from plr.protos.model.ids import NodeName
from plr.sidecar.core.base.fair_share import FORGOTTEN_AT_ONCE
from plr.sidecar.core.base.values import RejectReason, RequestId
from plr.sidecar.core.cloud.refused_copies import RefusedCopies, RefusedCopy
from plr.sidecar.core.seam.stats import EngineStats

ROBOT = NodeName("robot")


@pytest.mark.audit("dp-14")
def test_a_burst_is_not_forgotten_in_one_call() -> None:
    refused = RefusedCopies(EngineStats())
    copies = [RefusedCopy(ROBOT, RequestId(number.to_bytes(16, "big")), 0) for number in range(1000)]
    for copy in copies:
        refused.add(copy, RejectReason.DRAINING, "", 60.0, 0.0)
    before = len(refused)
    while len(refused):
        refused.why(copies[0], 61.0)
        assert 0 < before - len(refused) <= FORGOTTEN_AT_ONCE
        before = len(refused)
    refused.add(copies[0], RejectReason.DRAINING, "", 130.0, 70.0)
    assert refused.why(copies[0], 71.0) is not None
