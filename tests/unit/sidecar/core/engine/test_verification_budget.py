from __future__ import annotations

import pytest

from plr.protos.model.ids import NodeName
from plr.sidecar.core.engine.verification_budget import LOOKS_AT_ONCE, VerificationBudget


@pytest.mark.audit("sec-5")
def test_who_leaves_and_comes_back_has_no_looks_by_it() -> None:
    budget, peer = VerificationBudget(), NodeName("rogue")
    taken = 0
    for _ in range(100):
        while budget.take(peer, 1.0, at_home=True):
            taken += 1
        budget.keep(())
    assert taken == LOOKS_AT_ONCE
    assert budget.take(NodeName("other"), 100.0, at_home=True)
    budget.keep(())
    assert budget.take(peer, 100.0, at_home=True)
