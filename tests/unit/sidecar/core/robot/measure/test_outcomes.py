"""Which requests tell whether paths missed the deadline, alone and together, and what they tell."""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING

import pytest

from plr.sidecar.core.robot.measure.measurements import Measurements
from plr.sidecar.core.robot.measure.outcomes import measure_outcomes
from plr.sidecar.core.robot.request.request import Copy, CopyState, Request
from plr.sidecar.core.rules.service_rule import ServiceRule
from plr.sidecar.core.transfer.routes import Routes
from tests.support.builders import ECHO, TYPE, WLAN, WWAN, A, B, path, request_id

if TYPE_CHECKING:
    from plr.protos.model.report import Report
    from plr.sidecar.core.base.values import PathId
    from plr.sidecar.core.message.outbound import OutboundMessage

ETH_A, WLAN_A, WWAN_A, WWAN_B = path("eth0", A), path(WLAN, A), path(WWAN, A), path(WWAN, B)
NO_MESSAGE: OutboundMessage = None  # type: ignore[assignment]  # what is counted does not look at it


def copy_on(on: PathId, *, in_time: bool, sent_at: float = 0.0, state: CopyState = CopyState.DEAD) -> Copy:
    return Copy(on, sent_at, NO_MESSAGE, CopyState.ANSWERED if in_time else state, in_time=in_time)


def report_of(*copies: Copy, observed: bool) -> Report:
    rule = ServiceRule(ECHO, 1.0, 10.0, idempotent=True)
    request = Request(request_id(1), ECHO, TYPE, rule, None, 0.0, copies=list(copies), observed=observed)
    measurements = Measurements(Counter())
    for _ in range(2):
        measure_outcomes(request, measurements)
    return measurements.take(Routes(), [])


def counted(*copies: Copy, observed: bool = False) -> dict[tuple[str, str], tuple[int, int]]:
    """(requests, both missed) for each pair of interfaces."""
    joints = report_of(*copies, observed=observed).joints
    return {(joint.first.interface, joint.second.interface): (joint.requests, joint.both_missed) for joint in joints}


@pytest.mark.parametrize("observed", [False, True])
def test_two_copies_to_two_servers_always_tell(observed: bool) -> None:
    won, lost = copy_on(WLAN_A, in_time=True), copy_on(WWAN_B, in_time=False)
    both = copy_on(WLAN_A, in_time=False), copy_on(WWAN_B, in_time=False)
    assert counted(won, lost, observed=observed) == {(WLAN, WWAN): (1, 0)}
    assert counted(*both, observed=observed) == {(WLAN, WWAN): (1, 1)}


def test_of_more_copies_only_a_full_race_tells_even_when_all_have_missed() -> None:
    three = [copy_on(on, in_time=False) for on in (WWAN_B, WLAN_A, ETH_A)]
    assert counted(*three) == {}
    pairs = {("eth0", WLAN), ("eth0", WWAN), (WLAN, WWAN)}
    assert counted(*three, observed=True) == dict.fromkeys(pairs, (1, 1))


def test_copies_to_one_server_tell_in_a_full_race_as_another_may_be_hedged() -> None:
    same = copy_on(WLAN_A, in_time=False), copy_on(WWAN_A, in_time=False)
    assert counted(*same) == {}
    assert counted(*same, observed=True) == {(WLAN, WWAN): (1, 1)}


def test_a_copy_sent_in_trouble_counts_for_nothing() -> None:
    first = copy_on(WLAN_A, in_time=False), copy_on(WWAN_B, in_time=False)
    assert counted(*first, copy_on(ETH_A, in_time=True, sent_at=0.4)) == {(WLAN, WWAN): (1, 1)}
    assert counted(first[0], copy_on(WWAN_B, in_time=False, sent_at=0.4), observed=True) == {}


def test_what_a_server_refused_says_nothing_of_paths() -> None:
    refused = copy_on(WLAN_A, in_time=False, state=CopyState.REJECTED)
    assert counted(refused, copy_on(WWAN_B, in_time=False), observed=True) == {}


def test_a_single_copy_and_two_on_one_pair_have_no_company() -> None:
    assert counted(copy_on(WLAN_A, in_time=False)) == {}
    assert counted(copy_on(WLAN_A, in_time=False), copy_on(WLAN_A, in_time=False), observed=True) == {}
    assert counted(observed=True) == {}


def test_each_copy_of_a_full_race_counts_for_its_own_path_and_no_other_request() -> None:
    refused = copy_on(ETH_A, in_time=False, state=CopyState.REJECTED)
    copies = copy_on(WLAN_A, in_time=True), copy_on(WWAN_B, in_time=False), refused
    report = report_of(*copies, copy_on(WLAN_A, in_time=True, sent_at=0.4), observed=True)
    told = {latency.interface: (latency.requests, latency.missed) for latency in report.latencies}
    assert told == {WLAN: (1, 0), WWAN: (1, 1)}
    assert report_of(*copies, observed=False).latencies == ()
