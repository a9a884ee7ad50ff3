from __future__ import annotations

from plr.sidecar.core.interfaces.readiness import STUN_GRACE_S, Readiness
from tests.support.builders import WLAN, WWAN

BOTH = frozenset({4, 6})
LATE = 1.0 + STUN_GRACE_S


def test_without_stun_every_interface_is_ready_at_once() -> None:
    assert Readiness(stun_enabled=False).add(WLAN, BOTH, 1.0)


def test_an_interface_is_ready_once_stun_showed_it() -> None:
    readiness = Readiness(stun_enabled=True)
    assert not readiness.add(WLAN, BOTH, 1.0)
    assert readiness.mapped(WLAN, 4)
    assert not readiness.mapped(WLAN, 6), "it was ready"
    assert not readiness.mapped(WWAN, 4), "not ours"


def test_while_stun_answers_somebody_the_others_wait() -> None:
    readiness = Readiness(stun_enabled=True)
    for interface in (WLAN, WWAN):
        readiness.add(interface, BOTH, 1.0)
    readiness.mapped(WLAN, 4)
    readiness.mapped(WLAN, 6)
    readiness.failed(WLAN, 6)
    assert readiness.after_grace(LATE) == []
    readiness.failed(WLAN, 4)
    assert readiness.after_grace(LATE) == [WWAN]


def test_when_stun_answers_nobody_all_are_ready_after_the_grace_time() -> None:
    readiness = Readiness(stun_enabled=True)
    readiness.add(WLAN, BOTH, 1.0)
    readiness.add(WWAN, BOTH, 2.0)
    assert readiness.after_grace(LATE - 0.1) == []
    assert readiness.after_grace(LATE) == [WLAN]
    assert readiness.after_grace(LATE + 1.0) == [WWAN]
    assert readiness.after_grace(LATE + 2.0) == []


def test_an_interface_that_comes_back_while_the_control_plane_is_dead_is_used() -> None:
    readiness = Readiness(stun_enabled=True)
    readiness.add(WLAN, BOTH, 1.0)
    readiness.mapped(WLAN, 4)
    readiness.remove(WLAN)
    assert not readiness.add(WLAN, BOTH, 100.0)
    assert readiness.after_grace(100.0 + STUN_GRACE_S) == [WLAN]


def test_an_ipv6_only_interface_does_not_wait_for_servers_that_speak_ipv4() -> None:
    readiness = Readiness(stun_enabled=True)
    readiness.add(WLAN, BOTH, 1.0)
    readiness.add(WWAN, frozenset({6}), 1.0)
    readiness.mapped(WLAN, 4)
    assert readiness.waiting
    assert readiness.after_grace(LATE) == [WWAN]
    assert not readiness.waiting


def test_an_interface_that_gets_an_address_of_an_answered_family_waits_for_its_answer() -> None:
    readiness = Readiness(stun_enabled=True)
    readiness.add(WLAN, BOTH, 1.0)
    readiness.add(WWAN, frozenset({6}), 1.0)
    readiness.mapped(WLAN, 4)
    readiness.set_families(WWAN, BOTH)
    assert readiness.after_grace(LATE) == []
