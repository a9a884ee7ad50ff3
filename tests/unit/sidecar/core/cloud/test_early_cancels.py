from __future__ import annotations

import pytest

from plr.protos.model.ids import NodeName
from plr.sidecar.core.base.fair_share import FORGOTTEN_AT_ONCE
from plr.sidecar.core.cloud.early_cancels import MAX_EARLY_CANCELS, REMEMBER_CANCEL_S, EarlyCancels
from plr.sidecar.core.seam.stats import EngineStats
from tests.support.builders import request_id

ROBOT, OTHER = NodeName("robot"), NodeName("other")


def test_an_id_holds_for_its_robot_until_it_is_forgotten() -> None:
    cancels = EarlyCancels(EngineStats())
    cancels.add(ROBOT, request_id(1), 5.0)
    cancels.add(ROBOT, request_id(1), 9.0)
    assert cancels.holds(ROBOT, request_id(1), 5.0)
    assert not cancels.holds(OTHER, request_id(1), 5.0)
    assert not cancels.holds(ROBOT, request_id(2), 5.0)
    assert cancels.holds(ROBOT, request_id(1), 4.9 + REMEMBER_CANCEL_S)
    assert not cancels.holds(ROBOT, request_id(1), 5.0 + REMEMBER_CANCEL_S)
    assert len(cancels) == 0


def test_one_robot_fills_half_and_another_still_has_room() -> None:
    stats = EngineStats()
    cancels = EarlyCancels(stats)
    for number in range(MAX_EARLY_CANCELS):
        cancels.add(ROBOT, request_id(number), 1.0)
    assert len(cancels) == MAX_EARLY_CANCELS // 2
    assert stats.dropped["early_cancels_full"] == MAX_EARLY_CANCELS // 2
    cancels.add(OTHER, request_id(MAX_EARLY_CANCELS), 1.0)
    assert cancels.holds(OTHER, request_id(MAX_EARLY_CANCELS), 1.0)
    cancels.add(ROBOT, request_id(MAX_EARLY_CANCELS + 1), 1.0 + REMEMBER_CANCEL_S)
    assert cancels.holds(ROBOT, request_id(MAX_EARLY_CANCELS + 1), 1.0 + REMEMBER_CANCEL_S), (
        "what is forgotten makes room"
    )


@pytest.mark.audit("dp-10")
def test_a_burst_is_not_forgotten_in_one_call_and_holds_no_longer() -> None:
    cancels = EarlyCancels(EngineStats())
    for number in range(1000):
        cancels.add(ROBOT, request_id(number), 1.0)
    before = len(cancels)
    while len(cancels):
        assert not cancels.holds(ROBOT, request_id(999), 1.0 + REMEMBER_CANCEL_S)
        assert 0 < before - len(cancels) <= FORGOTTEN_AT_ONCE
        before = len(cancels)
