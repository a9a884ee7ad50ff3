"""How far a reader must jump to follow one request, which `python -m bench micro` shows: it must not creep up."""

from __future__ import annotations

import pytest

from bench.micro.request_walk import Leg, both_cores, walk_of_a_request

MOST_CALLS = 617
MOST_FILES = 66
MOST_CHANGES = 403


@pytest.fixture(scope="module")
def legs() -> list[Leg]:
    return walk_of_a_request()


def test_a_request_takes_no_more_calls_and_files_than_it_did(legs: list[Leg]) -> None:
    """Look at `python -m bench micro --calls` before you raise a limit; lower it when you have removed a detour."""
    whole = both_cores(legs)
    assert len(whole.calls) <= MOST_CALLS
    assert len(whole.files) <= MOST_FILES
    assert whole.changes <= MOST_CHANGES


def test_no_leg_is_empty(legs: list[Leg]) -> None:
    assert len(legs) == 8
    assert all(leg.calls for leg in legs)


@pytest.mark.parametrize(("role", "other"), [("robot", "cloud"), ("cloud", "robot")])
def test_one_role_runs_none_of_the_code_of_the_other(legs: list[Leg], role: str, other: str) -> None:
    engines = [leg for leg in legs if leg.name.startswith(f"{role} engine")]
    assert engines
    assert not [file for leg in engines for file in leg.files if f"/core/{other}/" in file]
