from __future__ import annotations

import pytest

from plr.protos.model.ids import InterfaceName
from plr.sidecar.core.control.race import ControlRace
from plr.sidecar.core.control.ways import STAGGER_S, Way, WayClass

A, B, C, D = (Way(InterfaceName(f"if{n}"), ("192.0.2.1", 1)) for n in range(4))


def test_ways_of_a_class_start_one_after_the_other() -> None:
    race = ControlRace([WayClass((A, B, C), 1.0)], 10.0)
    assert race.due(10.0) == [A]
    assert race.due(10.0) == []
    assert race.next_timer() == 10.0 + STAGGER_S
    assert race.due(10.0 + STAGGER_S) == [B]
    assert race.due(10.0 + 2 * STAGGER_S) == [C]
    assert race.next_timer() is None
    assert not race.over


def test_a_failure_starts_the_next_one_at_once() -> None:
    race = ControlRace([WayClass((A, B), 1.0)], 0.0)
    race.due(0.0)
    race.failed(A, "refused", 0.1)
    assert race.due(0.1) == [B]
    race.failed(B, "refused too", 0.2)
    assert race.over
    assert race.outcome() == f"{A}: refused; {B}: refused too"


def test_the_next_class_waits_for_the_head_start_or_for_the_failure_of_all_before() -> None:
    race = ControlRace([WayClass((A, B), 1.0), WayClass((C,), 0.5), WayClass((D,), 0.5)], 0.0)
    assert race.due(0.9) == [A]
    assert race.due(1.0) == [C]
    assert race.due(1.15) == [B]
    assert race.due(1.5) == [D]
    early = ControlRace([WayClass((A, B), 1.0), WayClass((C,), 0.5), WayClass((D,), 0.5)], 0.0)
    assert early.due(0.0) == [A]
    early.failed(A, "refused", 0.0)
    assert early.due(0.0) == [B]
    early.failed(B, "refused", 0.1)
    assert early.due(0.1) == [C]
    assert early.next_timer() == pytest.approx(0.6)
    early.failed(C, "refused", 0.2)
    assert early.due(0.2) == [D]


def test_a_pause_of_the_host_starts_no_burst() -> None:
    race = ControlRace([WayClass((A, B, C, D), 1.0)], 0.0)
    assert race.due(60.0) == [A]
    assert race.due(60.0 + STAGGER_S) == [B]


def test_what_runs_already_is_not_started_again() -> None:
    race = ControlRace([WayClass((A, B), 1.0)], 0.0, running=[A])
    assert race.due(0.0) == [B]
    assert race.outcome() == f"{A}: no answer; {B}: no answer"
    race.failed(A, "refused", 0.1)
    race.failed(B, "refused", 0.1)
    assert race.over


def test_no_ways() -> None:
    race = ControlRace([], 0.0)
    assert race.over
    assert race.next_timer() is None
    assert race.outcome() == "no interface or route leads to it"
