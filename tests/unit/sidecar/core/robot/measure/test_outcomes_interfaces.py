"""Which requests tell what two interfaces have in common, and what they tell."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from plr.protos.model.redundancy_mode import RedundancyMode
from plr.sidecar.core.base.request_id import OBSERVED_ONE_IN
from plr.sidecar.core.base.values import PathState
from plr.sidecar.core.robot.measure.outcomes import interface_outcomes
from plr.sidecar.core.robot.request.request import Copy, CopyState, Request
from plr.sidecar.core.rules.service_rule import ServiceRule
from plr.sidecar.core.transfer.routes import Routes
from tests.support.builders import ECHO, TYPE, WLAN, WWAN, A, B, path, request_id

if TYPE_CHECKING:
    from plr.protos.model.ids import InterfaceName
    from plr.sidecar.core.base.values import PathId
    from plr.sidecar.core.message.outbound import OutboundMessage

WLAN_A, WLAN_B, WWAN_A, WWAN_B, ETH_A = (path(*of) for of in ((WLAN, A), (WLAN, B), (WWAN, A), (WWAN, B), ("eth0", A)))
NO_MESSAGE: OutboundMessage = None  # type: ignore[assignment]  # what is counted does not look at it
BOTH, FIRST, SECOND, NONE = (True, True), (True, False), (False, True), (False, False)


def copy_on(on: PathId, *, in_time: bool, sent_at: float = 0.0, state: CopyState = CopyState.DEAD) -> Copy:
    return Copy(on, sent_at, NO_MESSAGE, CopyState.ANSWERED if in_time else state, in_time=in_time)


def told(
    *copies: Copy,
    dark: tuple[InterfaceName, ...] = (),
    raced: bool = False,
    mode: RedundancyMode = RedundancyMode.REPLICATE,
) -> dict[tuple[str, str, str | None], tuple[bool, bool]]:
    """(first missed, second missed) by (interface, interface, server)."""
    number = next(n for n in range(1, 100) if (request_id(n)[-1] % OBSERVED_ONE_IN == 0) is raced)
    rule = ServiceRule(ECHO, 1.0, 10.0, idempotent=True, redundancy=mode)
    request = Request(request_id(number), ECHO, TYPE, rule, None, 0.0, copies=list(copies), dark=dark)
    found = list(interface_outcomes(request, request.started_together()))
    assert all(outcome.raced is raced for _, outcome in found)
    return {
        (pair.first, pair.second, pair.server): (outcome.first_missed, outcome.second_missed) for pair, outcome in found
    }


@pytest.mark.parametrize("raced", [False, True])
def test_two_copies_to_two_servers_always_tell(raced: bool) -> None:
    won, lost = copy_on(WWAN_A, in_time=True), copy_on(WLAN_B, in_time=False)
    assert told(won, lost, raced=raced) == {(WLAN, WWAN, None): FIRST}
    assert told(copy_on(WLAN_A, in_time=False), copy_on(WWAN_B, in_time=False), raced=raced) == {
        (WLAN, WWAN, None): BOTH
    }


def test_of_more_copies_and_of_those_to_one_server_only_a_full_race_tells() -> None:
    three = [copy_on(on, in_time=False) for on in (WWAN_B, WLAN_A, ETH_A)]
    to_one = copy_on(WLAN_A, in_time=True), copy_on(WWAN_A, in_time=True)
    assert told(*three) == told(*to_one) == {}
    pairs = {("eth0", WLAN, A), ("eth0", WWAN, None), (WLAN, WWAN, None)}
    assert told(*three, raced=True) == dict.fromkeys(pairs, BOTH)
    assert told(*to_one, raced=True) == {(WLAN, WWAN, A): NONE}


def test_an_interface_without_a_path_missed() -> None:
    assert told(dark=(WLAN, WWAN)) == {(WLAN, WWAN, None): BOTH}
    assert told(copy_on(WLAN_A, in_time=True), dark=(WWAN,)) == {(WLAN, WWAN, None): SECOND}
    assert told(copy_on(WWAN_A, in_time=False), dark=(WLAN,)) == {(WLAN, WWAN, None): BOTH}
    assert told(dark=(WLAN,)) == {}


def test_an_interface_that_came_back_in_time_did_not_miss() -> None:
    assert told(copy_on(WLAN_A, in_time=True, sent_at=0.3), dark=(WLAN, WWAN)) == {(WLAN, WWAN, None): SECOND}
    assert told(copy_on(WLAN_A, in_time=False, sent_at=3.0), dark=(WLAN, WWAN)) == {(WLAN, WWAN, None): BOTH}
    rescued = copy_on(WWAN_B, in_time=False), copy_on(WLAN_A, in_time=True, sent_at=0.4)
    assert told(*rescued, dark=(WLAN,)) == {(WLAN, WWAN, None): SECOND}


def test_a_service_that_does_not_use_every_interface_tells_nothing_of_those_without_a_path() -> None:
    for mode in (RedundancyMode.SINGLE, RedundancyMode.HEDGE, RedundancyMode.ADAPTIVE):
        assert told(copy_on(WLAN_A, in_time=True), dark=(WWAN,), mode=mode) == {}
        assert told(dark=(WLAN, WWAN), mode=mode) == {}


def test_what_a_server_refused_says_nothing_of_interfaces() -> None:
    refused = copy_on(WLAN_A, in_time=False, state=CopyState.REJECTED)
    assert told(refused, copy_on(WWAN_B, in_time=False), raced=True) == {}


def test_dark_is_an_interface_that_has_paths_to_the_servers_and_none_that_is_up() -> None:
    routes = Routes()
    states = {WLAN_A: PathState.UP, WLAN_B: PathState.DOWN, WWAN_A: PathState.UNSTABLE, ETH_A: PathState.DOWN}
    for on, state in states.items():
        routes.set_state(on, state)
    assert set(routes.dark([A, B])) == {WWAN, "eth0"}
    assert set(routes.dark([B])) == {WLAN}
