"""When a request gets another copy with RedundancyMode.ADAPTIVE."""

from __future__ import annotations

import dataclasses

import pytest

from plr.protos.model.redundancy_mode import RedundancyMode
from plr.sidecar.core.base.values import PathState
from plr.sidecar.core.robot.dispatch.adaptive import SPREAD, UNFORESEEN, late_probability
from plr.sidecar.core.rules.budget import Budget
from tests.support.builders import ECHO, WLAN, WWAN, A, B, path
from tests.unit.sidecar.core.request_table import RACE, WLAN_A, WWAN_B, Table

SIZE = 120_000
LATENCY_S = 0.2


def known(target: float = 0.001, budgets: tuple[Budget, ...] = ()) -> Table:
    """The first pair answered LATENCY_S after it was asked; the deadline is a second."""
    table = Table(budgets=budgets)
    table.rule = dataclasses.replace(table.rule, redundancy=RedundancyMode.ADAPTIVE, adaptive_target=target)
    table.routes.set_rtt(WLAN_A, 0.02)
    table.routes.set_rtt(WWAN_B, 0.04)
    for number in range(1001, 1011):
        table.submit(number, now=number - 1011.0)
        table.respond(A, 0, number, number - 1011 + LATENCY_S)
    table.sent()
    return table


def looked_at(table: Table, until: float, *, arrives: float = 0.0) -> float | None:
    """When the request, sent at 0, got its second copy; `arrives`: share of its symbols for each second."""
    (symbols,) = [message.symbols for message in table.outbox._messages.values() if message.path == WLAN_A]
    while (timer := table.table.next_timer()) is not None and timer < until:
        arrived = min(len(symbols), int(arrives * timer * len(symbols)))
        symbols.acked[:arrived] = b"\1" * arrived
        table.table.handle_timer(timer)
        if table.sent():
            return timer
    return None


def test_the_probability_to_be_late_grows_as_time_runs_out() -> None:
    odds = [late_probability(0.1, left_s) for left_s in (10.0, 1.0, 0.2, 0.1, 0.05, 0.0)]
    assert odds == sorted(odds)
    assert odds[0] == pytest.approx(UNFORESEEN, abs=1e-6)
    assert odds[3] == pytest.approx(0.5, abs=0.01)
    assert odds[-1] == 1.0
    assert late_probability(0.0, 1.0) == UNFORESEEN
    assert 0 < SPREAD < 2


def test_while_nothing_is_known_all_go_at_once() -> None:
    table = Table()
    table.rule = dataclasses.replace(table.rule, redundancy=RedundancyMode.ADAPTIVE)
    table.submit()
    assert table.sent() == [WLAN_A, WWAN_B]


def test_one_copy_is_enough_while_it_gets_on() -> None:
    table = known()
    table.submit(payload=bytes(SIZE))
    assert table.sent() == [WLAN_A]
    assert looked_at(table, 0.3, arrives=4.0) is None
    table.respond(now=0.3)
    assert table.stats.hedged == {(WWAN, B, ECHO): 1}, "only while nothing was known"


@pytest.mark.parametrize("arrives", [0.0, 0.8, 1.6])
def test_the_second_goes_when_the_first_makes_no_progress_or_too_little(arrives: float) -> None:
    table = known()
    table.submit(payload=bytes(SIZE))
    table.sent()
    moment = looked_at(table, 1.0, arrives=arrives)
    assert moment is not None
    assert 0.0 < moment < 0.4


def test_the_higher_the_target_the_later() -> None:
    moments = []
    for target in (0.0001, 0.01, 0.1):
        table = known(target)
        table.submit(payload=bytes(SIZE))
        moments.append(0.0 if len(table.sent()) == 2 else looked_at(table, 1.0))
    assert None not in moments
    assert len(set(moments)) == 3
    assert moments == sorted(moments, key=lambda moment: moment or 0.0)


def test_what_was_slow_lately_is_not_the_first_choice() -> None:
    table = known()
    table.submit(payload=bytes(SIZE))
    table.sent()
    assert looked_at(table, 1.0) is not None
    table.table.handle_timer(0.4)
    table.respond(B, 1, now=0.5)
    assert table.stats.called_off[WLAN, A, ECHO] == 1
    table.sent()
    table.submit(2, payload=bytes(SIZE), now=0.51)
    assert table.sent()[0] == WWAN_B


def test_an_unstable_path_is_given_time_and_a_dead_one_none() -> None:
    for state, copies in ((PathState.UNSTABLE, []), (PathState.DOWN, [WWAN_B])):
        table = known()
        table.submit(payload=bytes(SIZE))
        table.sent()
        table.change(WLAN_A, state, now=0.01)
        assert table.sent() == copies


def test_a_copy_that_could_not_be_in_time_is_not_sent() -> None:
    table = known()
    table.routes.set_rtt(WWAN_B, 1.0)
    table.submit(payload=bytes(SIZE))
    assert table.sent() == [WLAN_A]
    assert looked_at(table, 1.0) is None


def test_with_one_interface_a_silent_server_makes_another_one_worth_asking() -> None:
    table = known()
    table.table.handle_timer(0.0)
    table.routes.forget_interface(WWAN)
    table.submit(payload=bytes(SIZE))
    assert table.sent() == [WLAN_A]
    assert looked_at(table, 1.0) is None, "the request has not arrived"


def test_with_one_interface_a_dead_path_makes_another_server_worth_asking() -> None:
    table = known()
    table.routes.forget_interface(WWAN)
    other = path(WLAN, B)
    table.routes.set_state(other, PathState.UP)
    table.routes.set_rtt(other, 0.04)
    table.submit()
    assert table.sent() == [WLAN_A]
    table.change(WLAN_A, PathState.UNSTABLE)
    assert table.sent() == []
    table.change(WLAN_A, PathState.DOWN)
    assert table.sent() == [other]


def test_a_refused_copy_is_asked_for_once() -> None:
    table = known(budgets=(Budget("*", extra_load=0.0),))
    before = sum(table.stats.copies_refused.values())
    table.submit(payload=bytes(SIZE))
    table.sent()
    assert looked_at(table, 1.0) is None
    assert sum(table.stats.copies_refused.values()) == before + 1


def test_the_second_is_called_off_in_races_too() -> None:
    table = known()
    table.submit(RACE, payload=bytes(SIZE))
    table.sent()
    assert looked_at(table, 1.0) is not None
    table.respond(A, 0, RACE, now=0.7)
    assert table.stats.called_off[WWAN, B, ECHO] >= 1
