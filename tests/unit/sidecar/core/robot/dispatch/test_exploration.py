"""One more copy now and then, beside the mapped ones and never at their cost."""

from __future__ import annotations

import itertools
import random
from dataclasses import replace

import pytest

from plr.protos.model.ids import Version
from plr.protos.model.mapping import Assignment, MappingSet, ServiceMapping
from plr.sidecar.core.base.values import PathId, PathState, RejectReason, RequestId
from plr.sidecar.core.robot.dispatch.exploration import (
    MAX_EXPLORING_BYTES,
    MAX_PER_S,
    MAX_SAVED,
    MAX_WAITING_MESSAGES,
    MIN_INTERVAL_S,
    ExplorationBudget,
)
from tests.support.builders import ECHO, WLAN, WWAN, A, B, path
from tests.unit.sidecar.core.request_table import RACE, WLAN_A, WWAN_B, Table

WLAN_B = path(WLAN, B)
MAPPED = (Assignment(WLAN, A), Assignment(WWAN, B))


def exploring(*mapped: Assignment, share: float = 0.01, idempotent: bool = True) -> Table:
    """By default wlan0 goes to cloud-a, wwan0 to cloud-b, and of wlan0 to cloud-b more is to be known."""
    table = Table(exploration=share, idempotent=idempotent)
    table.routes.set_state(WLAN_B, PathState.UP)
    table.routes.set_rtt(WLAN_B, 0.5)
    service = ServiceMapping(ECHO, mapped or MAPPED, explore=Assignment(WLAN, B))
    assert table.mapping.apply(MappingSet(Version(1), 1, (service,)), {WLAN, WWAN}, {A, B}) is None
    return table


def test_a_race_gets_one_more_copy_and_reports_it_like_any_other() -> None:
    table = exploring()
    table.submit(RACE)
    assert table.sent() == [WLAN_A, WWAN_B, WLAN_B]
    assert table.stats.explored == {(WLAN, B, ECHO): 1}
    for copy, server in enumerate((A, B, B)):
        table.respond(server, copy, RACE)
    report = table.measurements.take(table.routes, [])
    table.table.handle_timer(1.0)
    late = table.measurements.take(table.routes, [])
    judged = [*report.latencies, *late.latencies]
    assert {(one.interface, one.server): one.requests for one in judged if one.requests}[WLAN, B] == 1
    assert len([*report.joints, *late.joints]) == 3
    table.assert_empty()


@pytest.mark.parametrize(
    ("share", "idempotent", "number", "size"),
    [(0.0, True, RACE, 8), (0.01, False, RACE, 8), (0.01, True, 1, 8), (0.01, True, RACE, MAX_EXPLORING_BYTES + 1)],
    ids=["switched off", "may run once only", "no race", "large"],
)
def test_what_does_not_explore(share: float, idempotent: bool, number: int, size: int) -> None:
    table = exploring(share=share, idempotent=idempotent)
    table.submit(number, bytes(size))
    assert WLAN_B not in table.sent()


@pytest.mark.parametrize("state", [PathState.UNSTABLE, PathState.DOWN])
def test_a_path_that_is_not_up_is_not_explored(state: PathState) -> None:
    table = exploring()
    table.routes.set_state(WLAN_B, state)
    table.submit(RACE)
    assert table.sent() == [WLAN_A, WWAN_B]


def test_a_busy_interface_is_spared() -> None:
    table = exploring()
    for number in range(MAX_WAITING_MESSAGES):
        table.submit(RACE * number + 1)
    table.sent()
    table.submit(RACE)
    assert WLAN_B not in table.sent()


def explored(table: Table, share: float, interval_s: float, requests: int) -> list[float]:
    """When copies explored, of so many requests with random ids, each answered at once."""
    table.rule = replace(table.rule, exploration=share)
    rng = random.Random(1)
    times = []
    for number in range(requests):
        now = number * interval_s
        table.table.submit(RequestId(rng.randbytes(16)), ECHO, b"", now)
        times += [now] * table.sent().count(WLAN_B)
        for message in list(table.outbox._messages.values()):
            table.outbox.drop(message)
    return times


def test_the_share_is_kept_and_so_is_the_distance() -> None:
    times = explored(exploring(), 0.05, 1.0, 800)
    assert 30 < len(times) <= 41
    assert all(later - earlier >= MIN_INTERVAL_S for earlier, later in itertools.pairwise(times))


def test_however_many_requests_there_are_only_so_many_explore() -> None:
    times = explored(exploring(), 0.1, 0.02, 1000)
    assert 2 < len(times) <= 20 * MAX_PER_S + 2


def test_what_was_saved_up_is_spent_when_a_pair_is_named_a_moment_apart() -> None:
    table = exploring()
    named = table.mapping.services[ECHO]
    table.mapping.apply(MappingSet(Version(2), 1, (replace(named, explore=None),)), {WLAN, WWAN}, {A, B})
    assert explored(table, 0.1, 5.0, 100) == []
    table.mapping.apply(MappingSet(Version(3), 1, (named,)), {WLAN, WWAN}, {A, B})
    for number in range(100):
        table.submit(RACE * (number + 1), now=500.0 + number / 100)
        for message in list(table.outbox._messages.values()):
            table.outbox.drop(message)
    assert table.stats.explored[WLAN, B, ECHO] == 2


def test_no_more_is_saved_up_than_the_limit() -> None:
    budget = ExplorationBudget(0.0)
    for second in range(1000):
        budget.earn(0.1, float(second))
    bought = 0
    while budget.suffices(2000.0 + bought):
        budget.spend(2000.0 + bought)
        bought += 1
    assert bought == int(MAX_SAVED)


def after_submit(*mapped: Assignment, exploration: bool) -> Table:
    table = exploring(*mapped, share=0.01 if exploration else 0.0)
    table.submit(RACE)
    assert (WLAN_B in table.sent()) == exploration
    return table


def still_helped(table: Table) -> list[PathId]:
    return [sent for sent in table.sent() if sent != WLAN_B]


@pytest.mark.parametrize("exploration", [False, True])
def test_a_copy_that_explores_takes_no_help_from_a_request_in_trouble(exploration: bool) -> None:
    """Nothing that would be sent without it is left out: neither when a path dies nor after a refusal."""
    table = after_submit(Assignment(WLAN, A), exploration=exploration)
    table.change(WLAN_A, PathState.DOWN)
    assert still_helped(table) == [WWAN_B]
    table = after_submit(Assignment(WLAN, A), exploration=exploration)
    table.reject(RejectReason.OVERLOADED, number=RACE)
    assert still_helped(table) == [WWAN_B]


@pytest.mark.parametrize("exploration", [False, True])
def test_a_silent_server_is_hedged_whether_or_not_another_one_explores(exploration: bool) -> None:
    table = after_submit(Assignment(WLAN, A), exploration=exploration)
    first = next(message for message in table.outbox._messages.values() if message.path == WLAN_A)
    table.outbox.on_finished(A, first.number)
    table.table.handle_timer(0.5)
    assert still_helped(table) == [WWAN_B]
