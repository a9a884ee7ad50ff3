from __future__ import annotations

import pytest

from plr.controlplane.ca import Authority
from plr.protos.trust.clock_floor import SLACK_S, ClockFloor
from plr.protos.trust.identity import EXPIRED, CertificateError, IdentityRole, Trust

pytestmark = pytest.mark.audit("sec-9")

DAY_S = 86_400.0
BEGUN = 1_800_000_000.0


class Clock:
    """A host's, which somebody may set."""

    def __init__(self) -> None:
        self.time = BEGUN

    def __call__(self) -> float:
        return self.time


@pytest.fixture
def clock() -> Clock:
    return Clock()


def test_what_the_ca_signed_is_the_least_that_is_believed(clock: Clock) -> None:
    kept: list[float] = []
    floor = ClockFloor(clock, remember=kept.append)
    floor.note(BEGUN - DAY_S)
    assert floor.now() == BEGUN
    clock.time = 0.0
    assert floor.now() == BEGUN - DAY_S
    floor.note(BEGUN - 2 * DAY_S)
    assert (floor.floor, kept) == (BEGUN - DAY_S, [BEGUN - DAY_S])


def test_a_time_that_is_later_than_the_clock_does_not_count(clock: Clock) -> None:
    """The CA's clock may be ahead: all would be over for the whole fleet."""
    floor = ClockFloor(clock)
    floor.note(BEGUN + 365 * DAY_S)
    assert floor.now() == BEGUN
    clock.time = BEGUN + 400 * DAY_S  # a glitch: only now is that time past
    assert floor.now() == clock.time
    clock.time = BEGUN
    assert floor.now() == BEGUN


def test_an_earlier_runs_floor_holds(clock: Clock) -> None:
    clock.time = 0.0
    assert ClockFloor(clock, BEGUN).now() == BEGUN


def test_a_clock_that_is_behind_is_reported_once(clock: Clock) -> None:
    told: list[str] = []
    floor = ClockFloor(clock, BEGUN, alert=told.append)
    clock.time = BEGUN - SLACK_S + 1
    floor.now()
    assert not told, "a clock may be set a little"
    clock.time = BEGUN - DAY_S
    floor.now()
    floor.now()
    (alert,) = told
    assert "86400 s" in alert
    clock.time = BEGUN
    floor.now()
    clock.time = 0.0
    floor.now()
    assert len(told) == 2


def test_who_has_expired_does_not_come_back_with_the_clock(clock: Clock) -> None:
    ca = Authority.create(clock=clock)
    stolen = ca.issue("robot-1", IdentityRole.ROBOT, days=1.0).certificate_der
    clock.time += 2 * DAY_S
    ca.issue("robot-2", IdentityRole.ROBOT)
    ca.publish()
    trust = Trust(ca.ca_pem, ca.crl_pem())
    floor = ClockFloor(clock)
    floor.note_lists(trust)
    clock.time = BEGUN + DAY_S / 2
    assert trust.check(stolen, clock()).name == "robot-1", "as it was"
    with pytest.raises(CertificateError) as caught:
        trust.check(stolen, floor.now())
    assert caught.value.reason == EXPIRED
