from __future__ import annotations

from collections import Counter

import pytest

from plr.protos.model.ids import InterfaceName
from plr.sidecar.core.base.values import PathState
from plr.sidecar.core.control.watch import (
    CHEAPER,
    CONFIRMED_S,
    DOUBT_S,
    GONE,
    KEEPALIVE_S,
    LIVED_S,
    ROUND_TRIPS,
    SILENT,
    SILENT_S,
    SILENT_WITHOUT_NEWS_S,
    ControlWatch,
    Seen,
)
from plr.sidecar.core.control.ways import WELL_S, ControlInterface, ControlWays, Price, Way

WLAN, WWAN = InterfaceName("wlan0"), InterfaceName("wwan0")
OVER_WLAN, OVER_WWAN = Way(WLAN, ("192.0.2.1", 1)), Way(WWAN, ("192.0.2.1", 1))
UP, UNSTABLE, DOWN = PathState.UP, PathState.UNSTABLE, PathState.DOWN


class Net:
    """Two interfaces, and a connection that is acknowledged until `dark_at`."""

    def __init__(self, *, way: Way = OVER_WLAN, alone: bool = False) -> None:
        self.ways = ControlWays(Counter())
        self.wlan = ControlInterface(WLAN, frozenset({"10.0.0.2"}), Price())
        self.wwan = ControlInterface(WWAN, frozenset({"10.1.0.2"}), Price(billed=True))
        self.ways.set_interfaces((self.wlan,) if alone else (self.wlan, self.wwan), 0.0)
        self.ways.set_addresses([way.address])
        self.watch = ControlWatch(self.ways, way, way.interface, 0.0)
        self.rtt_s = 0.05

    def waits(self, since: float, until: float, *, heard_at: float | None = None) -> None:
        """Something was sent at `since` and is not acknowledged; nothing came since `heard_at`."""
        self.watch.sent(since)
        self.see(until, unacked=True, heard_at=since if heard_at is None else heard_at)

    def see(self, now: float, *, unacked: bool, heard_at: float) -> None:
        self.watch.saw(Seen(unacked, now - heard_at, self.rtt_s), now)

    def cause(self, now: float) -> str | None:
        leave = self.watch.judge(now)
        return None if leave is None else leave.cause


@pytest.mark.parametrize(("other", "limit_s"), [(UP, SILENT_S), (DOWN, SILENT_WITHOUT_NEWS_S)])
def test_silence_ends_it_while_another_interface_may_lead_there(other: PathState, limit_s: float) -> None:
    net = Net()
    net.ways.set_paths({WLAN: UP, WWAN: other}, 1.0)
    net.waits(10.0, 10.0 + limit_s - 0.01)
    assert net.cause(10.0 + limit_s - 0.01) is None
    assert net.cause(10.0 + limit_s) == SILENT


def test_sooner_when_the_data_plane_hears_nobody_either() -> None:
    net = Net()
    net.ways.set_paths({WLAN: UP, WWAN: UP}, 1.0)
    net.waits(10.0, 10.1)
    net.ways.set_paths({WLAN: UNSTABLE, WWAN: UP}, 10.1)
    assert net.cause(10.0 + CONFIRMED_S - 0.01) is None
    assert net.cause(10.0 + CONFIRMED_S) == SILENT


def test_never_sooner_than_the_connections_own_round_trips() -> None:
    net = Net()
    net.rtt_s = 0.8
    net.ways.set_paths({WLAN: UP, WWAN: UP}, 1.0)
    net.waits(10.0, 11.5)
    assert net.cause(11.5) is None
    assert net.cause(10.0 + ROUND_TRIPS * 0.8) == SILENT


def test_with_a_single_interface_tcp_decides() -> None:
    net = Net(alone=True)
    net.waits(10.0, 60.0)
    assert net.cause(60.0) is None
    assert net.watch.take_doubt(60.0) is None


def test_what_is_acknowledged_stays_whatever_the_data_plane_says() -> None:
    net = Net()
    net.ways.set_paths({WLAN: UP, WWAN: UP}, 1.0)
    net.ways.set_paths({WLAN: DOWN, WWAN: UP}, 10.0)
    for step in range(20):
        now = 10.1 + step / 2
        net.waits(now, now + 0.2, heard_at=now + 0.1)
        assert net.cause(now + 0.2) is None
        net.see(now + 0.3, unacked=False, heard_at=now + 0.3)
        assert net.cause(now + 0.3) is None


def test_the_kernels_unanswered_question_counts_since_it_was_asked() -> None:
    net = Net()
    net.ways.set_paths({WLAN: UP, WWAN: UP}, 1.0)
    net.see(9.0, unacked=False, heard_at=9.0)
    asked_at = 9.0 + KEEPALIVE_S
    assert net.watch.next_timer(9.0) == pytest.approx(asked_at + DOUBT_S)
    net.see(asked_at + DOUBT_S, unacked=True, heard_at=9.0)
    assert net.cause(asked_at + DOUBT_S) is None
    assert net.watch.take_doubt(asked_at + DOUBT_S) == WLAN
    net.ways.set_paths({WLAN: UNSTABLE, WWAN: UP}, asked_at + 0.3)
    assert net.cause(asked_at + 0.3) == SILENT


def test_the_data_plane_is_asked_once_for_each_silence() -> None:
    net = Net()
    net.waits(10.0, 10.1)
    assert net.watch.take_doubt(10.1) is None
    net.see(10.2, unacked=True, heard_at=10.0)
    assert net.watch.take_doubt(10.2) == WLAN
    assert net.watch.take_doubt(10.3) is None
    net.see(10.4, unacked=False, heard_at=10.4)
    net.waits(11.0, 11.2)
    assert net.watch.take_doubt(11.2) == WLAN


def test_an_interface_that_is_gone_ends_it_at_once() -> None:
    net = Net()
    net.ways.set_interfaces((net.wwan,), 5.0)
    assert net.cause(5.0) == GONE


def test_a_cheaper_interface_takes_it_back_in_a_quiet_moment() -> None:
    net = Net(way=OVER_WWAN)
    net.ways.set_paths({WLAN: UP, WWAN: UP}, 1.0)
    at = 1.0 + WELL_S
    assert net.watch.next_timer(2.0 + KEEPALIVE_S) is not None
    net.waits(at - 0.1, at, heard_at=at)
    assert net.cause(at) is None
    net.see(at + 0.1, unacked=False, heard_at=at + 0.1)
    leave = net.watch.judge(at + 0.1)
    assert leave is not None
    assert (leave.cause, leave.to) == (CHEAPER, (OVER_WLAN,))


def test_a_long_life_makes_up_for_disappointments() -> None:
    net = Net(way=OVER_WLAN)
    net.ways.disappointed(WLAN)
    net.ways.set_paths({WLAN: UP, WWAN: UP}, 1.0)
    assert net.ways.next_better(WWAN, 1.0) == 1.0 + 2 * WELL_S
    net.see(LIVED_S, unacked=False, heard_at=LIVED_S)
    assert net.ways.better(WWAN, 1.0 + WELL_S) == [OVER_WLAN]
