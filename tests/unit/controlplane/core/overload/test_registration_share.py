"""Who registers all the time is refused after a while, and nobody else is."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from plr.controlplane.core.base import member_table
from plr.controlplane.core.overload.registration_share import RETURN_COST, STARTS_BURST, STARTS_PER_S, RegistrationShare
from plr.controlplane.core.registry.registry import AcceptedRegistration, Refusal, Registry
from plr.protos.model.ids import NodeName, Role
from tests.support.samples import registration, stream

if TYPE_CHECKING:
    from collections.abc import Callable

    from plr.protos.model.members import Registration

pytestmark = pytest.mark.audit("ops-16")

SECONDS = 300


def admitted(made: Callable[[int], Registration]) -> int:
    """Of the registrations of one member, one a second."""
    registry = Registry(lease_s=5.0)
    found = [registry.register(made(second), stream(second), float(second)) for second in range(1, SECONDS + 1)]
    refused = [one for one in found if isinstance(one, Refusal)]
    assert set(refused) <= {Refusal.TOO_OFTEN}
    assert registry.counters.refused[Refusal.TOO_OFTEN] == len(refused)
    return sum(isinstance(one, AcceptedRegistration) for one in found)


def test_a_member_that_starts_all_the_time_is_let_in_as_often_as_its_share() -> None:
    of_new_sessions = admitted(lambda second: registration("cloud", Role.CLOUD, incarnation=second))
    of_one_session = admitted(lambda second: registration("cloud", Role.CLOUD, incarnation=second, session=7))
    for count in (of_new_sessions, of_one_session):
        assert STARTS_BURST <= count <= STARTS_BURST + STARTS_PER_S * SECONDS + 1


def test_a_run_that_only_connects_again_is_let_in_once_a_second() -> None:
    assert STARTS_PER_S / RETURN_COST >= 1.0
    assert admitted(lambda second: registration("robot", held=second)) == SECONDS


def test_the_share_of_one_is_not_anothers_and_a_stranger_takes_none_of_it() -> None:
    registry = Registry(lease_s=1e6)
    assert isinstance(registry.register(registration("robot"), stream(1), 0.0), AcceptedRegistration)
    for number in range(200):
        thief = registration("robot", token=b"another sidecar!", incarnation=9 + number)
        assert registry.register(thief, stream(2), 0.0) is Refusal.NAME_TAKEN
        registry.register(registration("other", incarnation=number, token=b"t" * 16), stream(2), 0.0)
    assert isinstance(registry.register(registration("robot", incarnation=2), stream(3), 0.0), AcceptedRegistration)


def test_who_registered_longest_ago_is_forgotten_first(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(member_table, "MAX_MEMBERS", 2)
    shares = RegistrationShare()
    a, b, c = (NodeName(name) for name in "abc")
    while shares.take(a, 0.0, new_run=True):
        pass
    assert shares.take(b, 0.0, new_run=True)
    assert not shares.take(a, 0.0, new_run=True)
    assert shares.take(c, 0.0, new_run=True)
    assert not shares.take(a, 0.0, new_run=True)
    assert len(shares.shares) == 2
