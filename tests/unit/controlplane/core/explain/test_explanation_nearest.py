"""A name that nobody knows is compared with few others, and the nearest is named all the same."""

from __future__ import annotations

import difflib

import pytest
from hypothesis import given
from hypothesis import strategies as st

from plr.controlplane.core.explain.explanation import MAX_COMPARED_NAMES, UnknownNameError, find
from plr.controlplane.core.policy.permits import Permits
from plr.controlplane.core.registry.registry import Registry
from plr.protos.model.ids import NodeName, Role, ServiceName
from plr.protos.model.members import CandidateSet, ServiceSet
from tests.support.samples import interfaces, offer, registration, stream

ROBOT = NodeName("robot")
ORDINARY = [f"/arm_{arm}/{task}" for arm in range(60) for task in ("plan_motion", "detect_objects", "grip/open")]


def said_of(name: str, offers: list[str]) -> str:
    members = Registry(lease_s=5.0)
    for number, (member, role) in enumerate((("robot", Role.ROBOT), ("cloud", Role.CLOUD))):
        members.register(registration(member, role), stream(number), 0.0)
        members.set_candidates(NodeName(member), CandidateSet(interfaces("eth0")))
    members.set_services(NodeName("cloud"), ServiceSet(tuple(map(offer, offers))))
    with pytest.raises(UnknownNameError) as caught:
        find(members, Permits(None), ROBOT, ServiceName(name))
    return str(caught.value)


def test_few_of_many_long_names_are_compared(monkeypatch: pytest.MonkeyPatch) -> None:
    compared = 0
    ratio = difflib.SequenceMatcher.ratio

    def count(matcher: difflib.SequenceMatcher[str]) -> float:
        nonlocal compared
        compared += 1
        return ratio(matcher)

    monkeypatch.setattr(difflib.SequenceMatcher, "ratio", count)
    offers = [f"/s{number:04}".ljust(250, "x") for number in range(1024)]
    wanted = offers[700].replace("x", "y", 1)
    assert said_of(wanted, offers).endswith(f"did you mean {offers[700]}?")
    assert 0 < compared <= 2 * MAX_COMPARED_NAMES, "difflib compares the best ones twice"


@given(st.sampled_from(ORDINARY), st.integers(1, 30), st.sampled_from(("", "x", "_9")))
def test_a_mistyped_name_is_told_the_same_as_from_a_comparison_with_all(name: str, at: int, typed: str) -> None:
    mistyped = name[:at] + typed + name[at + 1 :]
    if mistyped not in ORDINARY:
        (nearest,) = difflib.get_close_matches(mistyped, sorted(ORDINARY), n=1, cutoff=0.0)
        told = said_of(mistyped, ORDINARY).rpartition("did you mean ")[2].removesuffix("?")
        ratios = [difflib.SequenceMatcher(None, one, mistyped).ratio() for one in (told, nearest)]
        assert ratios[0] == pytest.approx(ratios[1])
