from __future__ import annotations

from plr.sidecar.core.base.values import PathState
from plr.sidecar.core.transfer.routes import Routes
from plr.sidecar.core.wire.frame import BASE_BYTES, FRAGMENT_OVERHEAD_BYTES
from tests.support.builders import WLAN, WWAN, A, B, path

FAST, SLOW, SHAKY = path(WLAN, A), path(WWAN, A), path(WLAN, A, 1)


def routes() -> Routes:
    table = Routes()
    for known, state, rtt_s in (
        (SLOW, PathState.UP, 0.1),
        (FAST, PathState.UP, 0.01),
        (SHAKY, PathState.UNSTABLE, 0.001),
        (path(WLAN, B), PathState.DOWN, 0.001),
    ):
        table.set_state(known, state)
        table.set_rtt(known, rtt_s)
    return table


def test_up_comes_before_fast_and_what_is_down_is_not_usable() -> None:
    assert [route.id for route in routes().usable((A, B))] == [FAST, SLOW, SHAKY]


def test_the_best_path_may_be_avoided_unless_it_is_the_only_one() -> None:
    table = routes()
    assert table.best_to(A) == FAST
    assert table.best_to(A, avoid=FAST) == SLOW
    for gone in (SLOW, SHAKY):
        table.set_state(gone, PathState.DOWN)
    assert table.best_to(A, avoid=FAST) == FAST
    assert table.best_to(B) is None


def test_a_path_that_carries_the_size_is_preferred_to_a_better_one() -> None:
    table = routes()
    table.set_max_datagram(SHAKY, 1472)
    assert table.best_to(A, size=1400) == SHAKY
    assert table.best_to(A, size=1200) == FAST
    assert table.best_to(A, size=1473) == FAST
    assert table.best_to(A, avoid=SHAKY, size=1400) == FAST
    table.set_state(SHAKY, PathState.UP)
    assert table.best_to(A, avoid=SHAKY, size=1400) == SHAKY


def test_a_path_that_was_down_carries_the_base_again() -> None:
    table = routes()
    for known in (FAST, SLOW, SHAKY):
        table.set_max_datagram(known, 1472)
    assert table.symbol_to(A) == 1472 - FRAGMENT_OVERHEAD_BYTES
    table.set_state(FAST, PathState.DOWN)
    assert table.symbol_to(A) == 1472 - FRAGMENT_OVERHEAD_BYTES
    table.set_state(FAST, PathState.UP)
    assert table.max_datagram(FAST) == BASE_BYTES
    assert table.symbol_to(A) == BASE_BYTES - FRAGMENT_OVERHEAD_BYTES


def test_the_best_over_one_interface() -> None:
    table = routes()
    best = table.best_over(WWAN, A)
    assert best is not None
    assert best.id == SLOW
    assert table.best_over(WLAN, B) is None


def test_unknown_paths_are_down() -> None:
    assert Routes().state(FAST) is PathState.DOWN
    assert not Routes().reaches(A)


def test_forgetting_a_peer_or_an_interface_leaves_nothing_of_it() -> None:
    table = routes()
    assert set(table.forget_interface(WLAN)) == {FAST, SHAKY, path(WLAN, B)}
    assert table.interfaces_to(A) == [WWAN]
    assert table.reaches(A)
    table.forget_peer(A)
    assert not table.reaches(A)
    assert table.all_to(A) == []
    assert not table._routes


def test_what_a_policer_dropped_is_not_expected_to_go_on() -> None:
    table = routes()
    table.note_fates(FAST, 50, 50)
    assert table.loss(FAST).share > 0.1
    table.note_fates(FAST, 90, 10, policed=True)
    assert table.loss(FAST).share == 0.0


def test_the_best_state_of_each_interface_is_told_when_it_changes() -> None:
    table = routes()
    assert table.best == {WLAN: PathState.UP, WWAN: PathState.UP}
    before = table.best
    table.set_state(SHAKY, PathState.UP)
    table.set_state(FAST, PathState.UNSTABLE)
    assert table.best is before
    table.set_state(SHAKY, PathState.DOWN)
    assert table.best == {WLAN: PathState.UNSTABLE, WWAN: PathState.UP}
    assert before == {WLAN: PathState.UP, WWAN: PathState.UP}
    table.forget_peer(A)
    assert table.best == {WLAN: PathState.DOWN}
    table.forget_interface(WLAN)
    assert table.best == {}
    table.set_state(FAST, PathState.UP)
    assert table.best == {WLAN: PathState.UP}
