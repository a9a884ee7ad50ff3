"""Which static peers are left out."""

from __future__ import annotations

import threading

import pytest

from plr.sidecar.ros import static_peers

pytestmark = pytest.mark.audit("ops-4")


def test_names_without_an_address_are_left_out() -> None:
    forever = threading.Event()

    def resolve(name: str) -> None:
        if name == "slow":
            forever.wait()
        if name == "nowhere":
            raise OSError("unknown")
        name.encode("idna")

    environment = {"ROS_STATIC_PEERS": f"here;nowhere;;slow;192.0.2.1;{'x' * 70}", "A": "b"}
    left_out = static_peers.unresolvable(environment, resolve, 0.2)
    forever.set()
    assert left_out == ("nowhere", "slow", "x" * 70)
    assert static_peers.without(environment, left_out) == {"ROS_STATIC_PEERS": "here;192.0.2.1", "A": "b"}
    assert static_peers.told(left_out).startswith("ROS_STATIC_PEERS: nowhere, slow, ")


def test_without_the_variable_nothing_is_looked_up() -> None:
    assert static_peers.unresolvable({}, lambda name: pytest.fail(name)) == ()
    assert static_peers.without({}, ()) == {}
