from __future__ import annotations

from sidecar.core.readiness import STUN_GRACE_S, Readiness
from tests.unit.sidecar.core.builders import WLAN, WWAN

LATE = 1.0 + STUN_GRACE_S


def test_without_stun_every_interface_is_ready_at_once() -> None:
    assert Readiness(stun_enabled=False).add(WLAN, 1.0)


def test_an_interface_is_ready_once_stun_showed_it() -> None:
    readiness = Readiness(stun_enabled=True)
    assert not readiness.add(WLAN, 1.0)
    assert readiness.mapped(WLAN, 4)
    assert not readiness.mapped(WLAN, 6), "it was ready"
    assert not readiness.mapped(WWAN, 4), "not ours"


def test_while_stun_answers_somebody_the_others_wait() -> None:
    readiness = Readiness(stun_enabled=True)
    for interface in (WLAN, WWAN):
        readiness.add(interface, 1.0)
    readiness.mapped(WLAN, 4)
    readiness.mapped(WLAN, 6)
    readiness.failed(WLAN, 6)
    assert readiness.after_grace(LATE) == []
    readiness.failed(WLAN, 4)
    assert readiness.after_grace(LATE) == [WWAN]


def test_when_stun_answers_nobody_all_are_ready_after_the_grace_time() -> None:
    readiness = Readiness(stun_enabled=True)
    readiness.add(WLAN, 1.0)
    readiness.add(WWAN, 2.0)
    assert readiness.after_grace(LATE - 0.1) == []
    assert readiness.after_grace(LATE) == [WLAN]
    assert readiness.after_grace(LATE + 1.0) == [WWAN]
    assert readiness.after_grace(LATE + 2.0) == []


def test_an_interface_that_comes_back_while_the_control_plane_is_dead_is_used() -> None:
    readiness = Readiness(stun_enabled=True)
    readiness.add(WLAN, 1.0)
    readiness.mapped(WLAN, 4)
    readiness.remove(WLAN)
    assert not readiness.add(WLAN, 100.0)
    assert readiness.after_grace(100.0 + STUN_GRACE_S) == [WLAN]
