from __future__ import annotations

from plr.sidecar.core.path.congestion.rtt import LONGEST_ANSWER_S
from plr.sidecar.core.path.introductions import INTRODUCER_S, MAX_INTRODUCTIONS, Introductions

HERE, THERE = ("192.0.2.1", 1), ("192.0.2.2", 2)


def test_introductions_wait_until_they_are_taken_and_few_at_once() -> None:
    introductions = Introductions()
    for probe_id in range(MAX_INTRODUCTIONS):
        assert not introductions.is_full
        introductions.note(HERE, probe_id, None)
    assert introductions.is_full
    assert [waiting.probe_id for waiting in introductions.take()] == list(range(MAX_INTRODUCTIONS))
    assert not introductions.waiting


def test_who_introduces_itself_twice_may_be_found_there_for_a_while() -> None:
    introductions = Introductions()
    introductions.found_down(HERE, 10.0)
    assert introductions.introducer(10.0) is None, "it may not have had our answer yet"
    introductions.found_down(THERE, 10.0 + INTRODUCER_S / 2)
    assert introductions.introducer(10.0 + INTRODUCER_S) == THERE
    assert introductions.introducer(10.0 + 2 * INTRODUCER_S) is None
    introductions.found_down(HERE, 10.0 + 2 * INTRODUCER_S)
    assert introductions.introducer(10.0 + 2 * INTRODUCER_S) is None, "the one before is long ago"


def test_an_introduction_may_lead_to_an_answer_for_a_while() -> None:
    introductions = Introductions()
    assert not introductions.awaits_proof(10.0)
    introductions.found_down(HERE, 10.0)
    assert introductions.awaits_proof(9.9 + LONGEST_ANSWER_S)
    assert not introductions.awaits_proof(10.0 + LONGEST_ANSWER_S)


def test_a_path_that_is_up_forgets_who_introduced_itself() -> None:
    introductions = Introductions()
    for now in (10.0, 11.0):
        introductions.found_down(HERE, now)
    introductions.forget_introducer()
    assert introductions.introducer(11.0) is None
    assert not introductions.awaits_proof(11.0)
