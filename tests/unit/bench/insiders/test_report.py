"""What a run of `make bench-insiders` is judged by."""

from __future__ import annotations

import pytest

from bench.dataplane.statistics import Calls
from bench.insiders.report import SETTLE_S, Phase, counted_for, flaws_of_log
from lab.attacker.hostile_link import ATTACKS, ESCAPES
from lab.attacker.orders import Orders

COUNTED = {
    'cloud_a/plr_datagrams_dropped_total{interface="eth0",reason="bad_keys"}': 5.0,
    'robot/plr_datagrams_dropped_total{interface="wlan0",reason="bad_keys"}': 2.0,
    'robot/plr_datagrams_dropped_total{interface="wlan0",reason="duplicate"}': 9.0,
}


def test_what_the_honest_counted_is_summed_over_them() -> None:
    assert counted_for("offers of keys with wrong proofs", COUNTED) == "datagrams_dropped bad_keys 7"
    assert counted_for("heartbeats", COUNTED) == ""


@pytest.mark.parametrize("bad", [ESCAPES.splitlines()[0], "\x1b[2J", "a\x00b", "\x9b31m", "\u202e", "Traceback (most"])
def test_a_log_holds_neither_tracebacks_nor_what_a_terminal_obeys(bad: str) -> None:
    assert flaws_of_log("robot", f"INFO fine\nINFO {bad}\n".encode())


def test_a_log_may_hold_letters_of_every_language() -> None:
    assert flaws_of_log("robot", "INFO größer, 漢字, ‘quoted’ \\x1b\n\tindented\n".encode()) == []


def test_requests_next_to_the_edges_of_a_phase_count_in_none() -> None:
    calls = Calls((10.0, 10.0 + SETTLE_S, 20.0), (0.001, 0.002, 0.003))
    assert Phase(10.0, 20.0 + SETTLE_S).of(calls) == [2.0]


def test_orders_name_attacks_by_patterns() -> None:
    orders = Orders(30.0, ("192.0.2.1", "2001:db8::1"), only=("*offers of keys*", "cancels"))
    assert orders.want("offers of keys with wrong proofs")
    assert not orders.want("small requests")
    assert len({attack.name for attack in ATTACKS}) == len(ATTACKS)
