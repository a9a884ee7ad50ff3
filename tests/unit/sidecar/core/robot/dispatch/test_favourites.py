from __future__ import annotations

from typing import TYPE_CHECKING, cast

import pytest

from plr.protos.model.ids import NodeName
from plr.sidecar.core.base.values import PathState
from plr.sidecar.core.robot.dispatch.favourites import FIRST_WAIT_S, LATE_MISSES, LONGEST_WAIT_S, MISSES, Favourites
from plr.sidecar.core.robot.request.mapping_table import MappingTable
from plr.sidecar.core.robot.request.request import Copy
from plr.sidecar.core.transfer.routes import Routes
from tests.support.builders import ECHO, WLAN, A, B, path

if TYPE_CHECKING:
    from plr.sidecar.core.base.values import PathId
    from plr.sidecar.core.message.outbound import OutboundMessage

C = NodeName("cloud-c")
NO_MESSAGE = cast("OutboundMessage", None)


@pytest.fixture
def routes() -> Routes:
    routes = Routes()
    for peer, rtt_s in ((A, 0.01), (B, 0.02), (C, 0.03)):
        routes.set_state(path(WLAN, peer), PathState.UP)
        routes.set_rtt(path(WLAN, peer), rtt_s)
    return routes


@pytest.fixture
def favourites(routes: Routes) -> Favourites:
    return Favourites(MappingTable(routes), routes)


def to(*peers: NodeName) -> list[PathId]:
    return [path(WLAN, peer) for peer in peers]


DEADLINE_S = 0.5


def miss(favourites: Favourites, times: int = MISSES) -> None:
    for _ in range(times):
        favourites.missed(ECHO, A)


def copy(peer: NodeName, sent_at: float, *, in_time: bool = False) -> Copy:
    return Copy(path(WLAN, peer), sent_at, NO_MESSAGE, in_time=in_time)


def test_the_nearest_mapped_server_becomes_the_favourite_and_stays_it(favourites: Favourites, routes: Routes) -> None:
    assert favourites.choose(ECHO, (A, B, C), to(B, C)) == B
    routes.set_rtt(path(WLAN, B), 0.5)
    assert favourites.choose(ECHO, (A, B, C), to(B, C)) == B


def test_it_goes_when_it_is_not_mapped_any_more_or_may_not_be_asked(favourites: Favourites) -> None:
    assert favourites.choose(ECHO, (A, B, C), to(A, B)) == A
    assert favourites.choose(ECHO, (A, B, C), to(B, C)) == B
    assert favourites.choose(ECHO, (A, C), to(C)) == C


def test_it_goes_when_it_is_out_of_reach(favourites: Favourites, routes: Routes) -> None:
    assert favourites.choose(ECHO, (A, B), to(A, B)) == A
    routes.set_state(path(WLAN, A), PathState.DOWN)
    assert favourites.choose(ECHO, (A, B), to(A, B)) == B
    routes.set_state(path(WLAN, B), PathState.UNSTABLE)
    assert favourites.choose(ECHO, (A, B), to(A, B)) is None


def test_a_server_that_answers_first_though_asked_later_becomes_the_favourite(favourites: Favourites) -> None:
    favourites.choose(ECHO, (A, B, C), to(A))
    favourites.answered(ECHO, copy(C, 1.0), [copy(A, 1.0)], DEADLINE_S, 1.1)
    assert favourites.choose(ECHO, (A, B, C), to(A)) == A, "it had no head start"
    favourites.answered(ECHO, copy(C, 1.1), [copy(A, 1.0)], DEADLINE_S, 1.7)
    assert favourites.choose(ECHO, (A, B, C), to(A)) == A, "it took longer than the deadline"
    favourites.answered(ECHO, copy(C, 1.1), [copy(A, 1.0)], DEADLINE_S, 1.2)
    assert favourites.choose(ECHO, (A, B, C), to(A)) == C, "although it is not mapped"


def test_an_answer_of_the_favourite_or_about_an_unknown_service_changes_nothing(favourites: Favourites) -> None:
    favourites.answered(ECHO, copy(C, 1.1), [copy(A, 1.0)], DEADLINE_S, 1.2)
    favourites.missed(ECHO, A)
    assert not favourites.may_try(ECHO, 0.0)
    assert favourites.choose(ECHO, (A, B), to(A, B)) == A
    favourites.answered(ECHO, copy(A, 1.1), [copy(B, 1.0)], DEADLINE_S, 1.2)
    assert favourites.choose(ECHO, (A, B), to(A, B)) == A


def test_another_server_is_tried_after_misses_of_the_favourite_in_a_row(favourites: Favourites) -> None:
    favourites.choose(ECHO, (A, B), to(A, B))
    miss(favourites, MISSES - 1)
    favourites.missed(ECHO, B)
    assert not favourites.may_try(ECHO, 1.0)
    favourites.answered(ECHO, copy(A, 1.0, in_time=True), [], DEADLINE_S, 1.1)
    favourites.missed(ECHO, A)
    assert not favourites.may_try(ECHO, 1.0)
    miss(favourites, MISSES - 1)
    assert favourites.may_try(ECHO, 1.0)
    favourites.move(ECHO, B)
    assert not favourites.may_try(ECHO, 1.0)


def test_a_favourite_that_answers_late_is_tried_against_another_after_more_misses(favourites: Favourites) -> None:
    favourites.choose(ECHO, (A, B), to(A, B))
    for number in range(LATE_MISSES):
        assert not favourites.may_try(ECHO, 1.0)
        favourites.missed(ECHO, A)
        favourites.answered(ECHO, copy(A, float(number)), [], DEADLINE_S, number + 2.0)
    assert favourites.may_try(ECHO, 1.0)


def test_the_time_between_tries_doubles_until_an_answer_in_time(favourites: Favourites) -> None:
    favourites.choose(ECHO, (A, B), to(A, B))
    miss(favourites)
    now, waits = 5.0, []
    for _ in range(8):
        favourites.tried(ECHO, now)
        assert not favourites.may_try(ECHO, now)
        next_try_at = favourites._favourites[ECHO].next_try_at
        assert favourites.may_try(ECHO, next_try_at)
        waits.append(next_try_at - now)
        now = next_try_at
    assert waits == pytest.approx([min(FIRST_WAIT_S * 2**number, LONGEST_WAIT_S) for number in range(8)])
    favourites.answered(ECHO, copy(A, now, in_time=True), [], DEADLINE_S, now + 0.1)
    miss(favourites)
    assert favourites.may_try(ECHO, now)


def test_what_did_not_help_long_ago_is_tried_as_at_first(favourites: Favourites) -> None:
    favourites.choose(ECHO, (A, B), to(A, B))
    miss(favourites)
    for now in (1.0, 2.0, 3.0):
        favourites.tried(ECHO, now)
    now = 4.0 + 2 * LONGEST_WAIT_S
    favourites.tried(ECHO, now)
    assert favourites.may_try(ECHO, now + FIRST_WAIT_S)


def test_another_server_is_the_favourite_or_the_nearest_that_is_reached(favourites: Favourites, routes: Routes) -> None:
    assert favourites.other(ECHO, A, (A, B, C), to(A)) == B
    favourites.choose(ECHO, (A, B, C), to(A))
    favourites.move(ECHO, C)
    assert favourites.other(ECHO, A, (A, B, C), to(A)) == C
    routes.set_state(path(WLAN, C), PathState.DOWN)
    assert favourites.other(ECHO, A, (A, B, C), to(A)) == B
    assert favourites.other(ECHO, A, (A, C), to(A)) is None
