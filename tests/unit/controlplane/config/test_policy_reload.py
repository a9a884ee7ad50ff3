"""What the log says of the policy in force: one that allows nothing is worth a warning."""

from __future__ import annotations

import logging

import pytest

from plr.controlplane.config.policy_reload import announce
from plr.controlplane.core.policy.policy import CallRule, OfferRule, Policy

CALLS = (CallRule(("*",), ("/*",), ("*",)),)
OFFERS = (OfferRule(("*",), ("/*",)),)


@pytest.mark.audit("ops-7")
@pytest.mark.parametrize(
    ("policy", "level", "said"),
    [
        (None, logging.WARNING, "there is no policy"),
        (Policy((), ()), logging.WARNING, "no robot may call any service"),
        (Policy((), OFFERS), logging.WARNING, "no robot may call any service"),
        (Policy(CALLS, ()), logging.WARNING, "no cloud may offer any service"),
        (Policy(CALLS, OFFERS), logging.INFO, "rules for calls 1, for offers 1"),
    ],
)
def test_the_policy_in_force_is_announced(
    caplog: pytest.LogCaptureFixture, policy: Policy | None, level: int, said: str
) -> None:
    with caplog.at_level(logging.INFO, "plr.controlplane.config.policy_reload"):
        announce(policy)
    (record,) = caplog.records
    assert record.levelno == level
    assert said in record.getMessage()
