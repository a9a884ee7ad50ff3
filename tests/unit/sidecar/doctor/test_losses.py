"""Tests what is blamed for lost datagrams: the interface, the peer, this host or the path alone."""

from __future__ import annotations

from itertools import product
from typing import Any

import pytest

from plr.sidecar.doctor import losses, running_checks
from plr.sidecar.doctor.finding import Level

WLAN, WWAN = "wlan0", "wwan0"


def path(interface: str, peer: str, lost: int = 0, *, sent: int = 200, state: str = "up") -> dict[str, Any]:
    return {
        "interface": interface, "peer": peer, "remote": 0, "address": ["192.0.2.1", 24700], "state": state,
        "since_s": 600.0, "reason": "answers", "rtt_s": 0.02, "sent": 100_000, "lost": 30_000, "proven_s": 0.1,
        "rests": False, "recent": {"window_s": 45.0, "sent": sent, "lost": lost},
    }  # fmt: skip


def grid(lossy: set[tuple[str, str]], peers: str = "abc") -> list[dict[str, Any]]:
    return [path(name, peer, 40 if (name, peer) in lossy else 0) for name, peer in product((WLAN, WWAN), peers)]


def blamed(paths: list[dict[str, Any]]) -> list[str]:
    return [finding.text.partition(":")[0] for finding in losses.blame(paths).findings]


def warned(paths: list[dict[str, Any]]) -> list[str]:
    found = running_checks.paths({"paths": paths, "node": {"up_s": 900.0}}, {})
    return [finding.text.partition(":")[0] for finding in found if finding.level is not Level.OK]


@pytest.mark.parametrize(
    ("lossy", "expected"),
    [
        (set(), []),
        ({(WLAN, "b"), (WWAN, "b")}, ["b"]),
        ({(WWAN, "a"), (WWAN, "b"), (WWAN, "c")}, [WWAN]),
        ({(WWAN, "a"), (WWAN, "b")}, [WWAN]),
        ({(WWAN, "a"), (WWAN, "b"), (WWAN, "c"), (WLAN, "c")}, [WWAN]),
        ({(WWAN, "a")}, []),
        (set(product((WLAN, WWAN), "abc")), ["this host"]),
    ],
)
def test_who_is_blamed(lossy: set[tuple[str, str]], expected: list[str]) -> None:
    assert blamed(grid(lossy)) == expected


def test_with_one_peer_it_is_the_peer_and_with_one_interface_the_interface() -> None:
    assert blamed([path(WLAN, "a", 40), path(WWAN, "a", 40)]) == ["a"]
    assert blamed([path(WLAN, "a", 40), path(WLAN, "b", 40)]) == [WLAN]
    assert blamed([path(WLAN, "a", 40)]) == []


def test_a_few_lossy_robots_of_many_are_no_fault_of_the_servers_interface() -> None:
    robots = [path("eth0", f"robot-{number}", 40 if number < 3 else 0) for number in range(10)]
    assert blamed(robots) == []
    assert len(warned(robots)) == 3


def test_each_cause_is_warned_of_once_and_its_paths_refer_to_it() -> None:
    paths = grid({(WLAN, "b"), (WWAN, "b"), (WLAN, "a")})
    assert warned(paths) == ["b", "wlan0 to a (192.0.2.1"]
    texts = [finding.text for finding in running_checks.paths({"paths": paths, "node": {"up_s": 900.0}}, {})]
    assert sum(text.endswith("20 % of 200 datagrams lost in the last 45 s: see b above") for text in texts) == 2
    assert "b: datagrams to it get lost over wlan0, wwan0: 20 % to 20 % lost in the last 45 s" in texts


def test_the_past_and_a_handful_of_datagrams_say_nothing() -> None:
    assert warned([path(WLAN, "a")]) == []  # 30 % of all datagrams were lost, long ago
    assert warned([path(WLAN, "a", 4, sent=40)]) == []
    assert warned([path(WLAN, "a", 10, sent=15)]) == []
    assert warned([path(WLAN, "a", 5, sent=40)]) == ["wlan0 to a (192.0.2.1"]
    assert "nothing sent in the last 45 s" in losses.told(path(WLAN, "a", sent=0))


def test_an_earlier_version_tells_the_sum_of_the_whole_life() -> None:
    old = path(WLAN, "a")
    del old["recent"]
    assert losses.told(old) == "30 % lost since the path is known"
    assert warned([old]) == ["wlan0 to a (192.0.2.1"]
