from __future__ import annotations

from collections import Counter

import pytest

from plr.protos.model.ids import Address, InterfaceName
from plr.sidecar.core.base.values import PathState
from plr.sidecar.core.control.ways import (
    ADDRESSES_FULL,
    FAILED_FIRST_S,
    FAILED_MAX_S,
    HEAD_START_S,
    LIVING_HEAD_START_S,
    MAX_ADDRESSES,
    MAX_STATES,
    MAX_WELL_S,
    WELL_S,
    ControlInterface,
    ControlWays,
    Life,
    Price,
    Way,
)

WLAN, WWAN, ETH = InterfaceName("wlan0"), InterfaceName("wwan0"), InterfaceName("eth0")
V4: Address = ("192.0.2.1", 50051)
V6: Address = ("2001:db8::1", 50051)
OTHER: Address = ("192.0.2.2", 50051)
UP, UNSTABLE, DOWN = PathState.UP, PathState.UNSTABLE, PathState.DOWN
BILLED = Price(billed=True, cost_per_request=1.0)
FREE = Price(cost_per_request=1.0)


def interface(name: InterfaceName, price: Price = FREE, *addresses: str) -> ControlInterface:
    return ControlInterface(name, frozenset(addresses or ("10.0.0.2", "fd00::2")), price)


def ways_of(*interfaces: ControlInterface, addresses: tuple[Address, ...] = (V4,)) -> ControlWays:
    ways = ControlWays(Counter())
    ways.set_interfaces(interfaces, 0.0)
    ways.set_addresses(addresses)
    return ways


def order(ways: ControlWays, now: float = 0.0) -> list[Way]:
    return [way for one in ways.classes(now) for way in one.ways]


def test_the_cheaper_interfaces_come_first_and_the_routing_table_last() -> None:
    ways = ways_of(interface(WWAN, BILLED), interface(ETH, Price(cost_per_request=2.0)), interface(WLAN))
    assert order(ways) == [Way(WLAN, V4), Way(ETH, V4), Way(WWAN, V4), Way(None, V4)]
    assert [one.head_start_s for one in ways.classes(0.0)] == [HEAD_START_S] * 4
    ways.set_paths({WLAN: UP}, 1.0)
    assert ways.classes(1.0)[0].head_start_s == LIVING_HEAD_START_S


def test_addresses_come_with_the_families_in_turn_over_interfaces_that_have_them() -> None:
    ways = ways_of(interface(WLAN, FREE, "10.0.0.2"), interface(WWAN, FREE, "fd00::2"), addresses=(V4, OTHER, V6))
    assert [way for way in order(ways) if way.interface] == [Way(WLAN, V4), Way(WWAN, V6), Way(WLAN, OTHER)]


def test_this_hosts_own_addresses_are_reached_through_no_interface() -> None:
    ways = ways_of(interface(WLAN, FREE, V4[0]), addresses=(("127.0.0.1", 1), ("::1", 1), V4))
    assert all(way.interface is None for way in order(ways))
    assert ways.owner(V4[0]) == WLAN
    assert ways.owner("192.0.2.99") is None


def test_without_the_right_to_bind_the_routing_table_is_all_there_is() -> None:
    ways = ways_of(interface(WLAN))
    ways.can_bind = False
    assert order(ways) == [Way(None, V4)]
    assert ways.another(WLAN, 0.0) is None


def test_what_worked_last_comes_first_within_its_price() -> None:
    ways = ways_of(interface(WLAN), interface(WWAN), interface(ETH, BILLED), addresses=(V4, OTHER))
    ways.proven(Way(WWAN, OTHER))
    assert order(ways)[:3] == [Way(WWAN, OTHER), Way(WLAN, OTHER), Way(WWAN, V4)]
    assert order(ways)[4].interface == ETH


def test_a_silent_interface_comes_after_the_others_only_while_somebody_is_heard_elsewhere() -> None:
    ways = ways_of(interface(WLAN), interface(WWAN, BILLED))
    ways.set_paths({WLAN: UP, WWAN: UP}, 1.0)
    ways.set_paths({WLAN: UNSTABLE, WWAN: UP}, 2.0)
    assert ways.life(WLAN) is Life.SILENT
    assert ways.silent_since(WLAN) == 2.0
    assert order(ways)[:2] == [Way(WWAN, V4), Way(WLAN, V4)]
    ways.set_paths({WLAN: DOWN, WWAN: UNSTABLE}, 3.0)
    assert ways.silent_since(WLAN) is None, "the peers may be gone"
    assert order(ways)[0] == Way(WLAN, V4)
    ways.set_paths({}, 4.0)
    assert ways.life(WLAN) is Life.UNKNOWN


def test_paths_that_were_never_up_say_nothing() -> None:
    """A network that lets no UDP through may well let TCP."""
    ways = ways_of(interface(WLAN), interface(WWAN))
    ways.set_paths({WLAN: DOWN, WWAN: UP}, 1.0)
    assert ways.life(WLAN) is Life.UNKNOWN
    assert order(ways)[0] == Way(WLAN, V4)


def test_an_interface_that_comes_after_its_paths_is_known_at_once() -> None:
    ways = ways_of(interface(WLAN))
    ways.set_paths({WLAN: UP, WWAN: UP}, 1.0)
    assert ways.life(WWAN) is Life.UNKNOWN
    ways.set_interfaces((interface(WLAN), interface(WWAN)), 2.0)
    assert ways.life(WWAN) is Life.LIVING


def test_a_way_that_failed_goes_to_the_end_for_longer_each_time_until_it_is_proven() -> None:
    ways = ways_of(interface(WLAN), interface(WWAN))
    now, pause_s = 0.0, FAILED_FIRST_S
    for _ in range(8):
        ways.failed(Way(WLAN, V4), now)
        assert order(ways, now)[0] == Way(WWAN, V4)
        assert order(ways, now + pause_s - 0.1)[0] == Way(WWAN, V4)
        now += pause_s
        assert order(ways, now)[0] == Way(WLAN, V4)
        pause_s = min(2.0 * pause_s, FAILED_MAX_S)
    ways.failed(Way(WLAN, V4), now)
    ways.proven(Way(WLAN, V4))
    assert order(ways, now)[0] == Way(WLAN, V4)


def test_a_way_that_fell_silent_is_avoided_until_its_interface_is_heard_again() -> None:
    ways = ways_of(interface(WLAN), interface(WWAN))
    ways.set_paths({WLAN: UP, WWAN: UP}, 0.0)
    ways.fell_silent(Way(WLAN, V4), WLAN, 1.0)
    assert order(ways, 1.0)[0] == Way(WWAN, V4)
    assert ways.another(WWAN, 1.0) is None
    assert order(ways, 1.0 + FAILED_FIRST_S)[0] == Way(WLAN, V4)
    ways.set_paths({WLAN: UNSTABLE, WWAN: UP}, 1.1)
    ways.set_paths({WLAN: UP, WWAN: UP}, 2.0)
    assert order(ways, 2.0)[0] == Way(WLAN, V4)
    assert ways.another(WWAN, 2.0) is Life.LIVING
    ways.fell_silent(Way(WLAN, V4), WLAN, 3.0)
    ways.proven(Way(WLAN, V4))
    assert order(ways, 3.0)[0] == Way(WLAN, V4)


def test_a_control_plane_that_refuses_does_so_over_every_interface() -> None:
    ways = ways_of(interface(WLAN), interface(WWAN, BILLED), addresses=(V4, OTHER))
    ways.failed(Way(WLAN, V4), 0.0, whole_address=True)
    assert order(ways)[:2] == [Way(WLAN, OTHER), Way(WWAN, OTHER)]
    assert order(ways)[-2:] == [Way(None, OTHER), Way(None, V4)]


def test_another_interface_is_one_that_may_lead_there() -> None:
    ways = ways_of(interface(WLAN), interface(WWAN), interface(ETH, FREE, "fd00::3"))
    assert ways.another(WLAN, 0.0) is Life.UNKNOWN
    ways.set_paths({WWAN: UP}, 1.0)
    assert ways.another(WLAN, 1.0) is Life.LIVING
    ways.failed(Way(WWAN, V4), 1.0)
    assert ways.another(WLAN, 1.0) is None, "eth0 has no IPv4"


def test_a_cheaper_interface_takes_over_when_it_has_been_well_for_a_while() -> None:
    ways = ways_of(interface(WLAN), interface(WWAN, BILLED))
    assert ways.next_better(WWAN, 0.0) is None
    ways.set_paths({WLAN: UP, WWAN: UP}, 1.0)
    assert ways.better(WWAN, 1.0) == []
    assert ways.next_better(WWAN, 1.0) == 1.0 + WELL_S
    assert ways.better(WWAN, 1.0 + WELL_S) == [Way(WLAN, V4)]
    assert ways.next_better(WWAN, 1.0 + WELL_S) is None
    assert ways.better(WLAN, 100.0) == []
    assert ways.better(None, 100.0) == []
    ways.set_paths({WLAN: UNSTABLE, WWAN: UP}, 101.0)
    ways.set_paths({WLAN: UP, WWAN: UP}, 102.0)
    assert ways.better(WWAN, 102.0) == []


def test_one_that_disappoints_has_to_be_well_for_longer_even_if_it_was_away() -> None:
    ways = ways_of(interface(WLAN), interface(WWAN, BILLED))
    for _ in range(10):
        ways.disappointed(WLAN)
    ways.disappointed(None)
    ways.set_interfaces((interface(WWAN, BILLED),), 1.0)
    ways.set_interfaces((interface(WLAN), interface(WWAN, BILLED)), 2.0)
    ways.set_paths({WLAN: UP, WWAN: UP}, 3.0)
    assert ways.next_better(WWAN, 3.0) == 3.0 + MAX_WELL_S
    ways.held_well(WLAN)
    assert ways.next_better(WWAN, 3.0) == 3.0 + WELL_S
    ways.failed(Way(WLAN, V4), 3.0 + WELL_S)
    assert ways.next_better(WWAN, 3.0 + WELL_S) == 3.0 + WELL_S + FAILED_FIRST_S


def test_addresses_beyond_the_limit_are_counted() -> None:
    drops: Counter[str] = Counter()
    ways = ControlWays(drops)
    assert ways.empty
    ways.set_addresses([(f"192.0.2.{n}", 1) for n in range(MAX_ADDRESSES + 3)])
    assert len(order(ways)) == MAX_ADDRESSES
    assert drops[ADDRESSES_FULL] == 3


def test_the_past_of_no_more_interfaces_than_that_is_remembered() -> None:
    ways = ControlWays(Counter())
    for number in range(3 * MAX_STATES):
        ways.set_interfaces((interface(InterfaceName(f"ppp{number}")),), float(number))
        assert len(ways._states) <= MAX_STATES + 1


@pytest.mark.parametrize(
    ("way", "text"), [(Way(WLAN, V4), "192.0.2.1:50051 over wlan0"), (Way(None, V6), "[2001:db8::1]:50051")]
)
def test_a_way_in_words(way: Way, text: str) -> None:
    assert str(way) == text
