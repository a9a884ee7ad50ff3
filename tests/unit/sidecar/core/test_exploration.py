"""One more copy now and then, beside the mapped ones and never at their cost."""

from __future__ import annotations

import itertools
import random

import pytest

from protos.model import Assignment, MappingSet, ServiceMapping, Version
from sidecar.core.copies import OBSERVED_ONE_IN
from sidecar.core.events import RejectReason, RequestId
from sidecar.core.exploration import MAX_REQUEST_BYTES, MAX_WAITING_MESSAGES, MIN_INTERVAL_S
from sidecar.core.path_id import PathId, PathState
from tests.unit.sidecar.core.builders import ECHO, TYPE, WLAN, WWAN, A, B, path
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
    [(0.0, True, RACE, 8), (0.01, False, RACE, 8), (0.01, True, 1, 8), (0.01, True, RACE, MAX_REQUEST_BYTES + 1)],
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


def test_copies_that_explore_keep_their_distance() -> None:
    table = exploring(share=0.1)
    explored = []
    for tenth in range(300):
        now = tenth / 10
        table.submit(RACE * (tenth + 1), now=now)
        explored += [now] * table.sent().count(WLAN_B)
        for copy, server in enumerate((A, B, B)):
            table.respond(server, copy, RACE * (tenth + 1), now)
    assert len(explored) > 2
    assert all(later - earlier >= MIN_INTERVAL_S for earlier, later in itertools.pairwise(explored))


def test_the_share_is_kept_over_random_ids() -> None:
    table = exploring(share=0.05)
    rng = random.Random(1)
    for number in range(4000):
        request_id = RequestId(rng.randbytes(16))
        now = number * MIN_INTERVAL_S
        table.table.submit(request_id, ECHO, TYPE, table.rule, b"", now)
        table.table.handle_timer(now + 0.9 * MIN_INTERVAL_S)
        for message in list(table.outbox._messages.values()):
            table.outbox.drop(message)
    assert 0.04 < sum(table.stats.explored.values()) / 4000 < 0.06
    assert OBSERVED_ONE_IN * table.rule.exploration < 1.0


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
