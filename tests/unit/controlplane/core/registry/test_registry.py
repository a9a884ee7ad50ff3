"""Leases, incarnations and limits of the registry, in simulated time."""

from __future__ import annotations

from dataclasses import replace

import pytest

from plr.controlplane.core.overload.postponed import COUNTED_BURST
from plr.controlplane.core.registry import registry as registry_module
from plr.controlplane.core.registry.registry import MAX_POSTPONED, POSTPONE_S, AcceptedRegistration, Refusal, Registry
from plr.protos.model.ids import NodeName, Role
from plr.protos.model.members import CandidateSet, RemovalReason, ServiceSet
from tests.support.samples import interfaces, offer, registration, stream

ROBOT = NodeName("robot")
LEASE_S = 5.0
ALERT_AT = 10
"""Of PlrControlPlaneOverloaded, in five minutes."""


@pytest.fixture
def registry() -> Registry:
    return Registry(lease_s=LEASE_S)


def test_a_silent_sidecar_disappears_when_its_lease_ends(registry: Registry) -> None:
    assert registry.register(registration("robot"), stream(1), 0.0) == AcceptedRegistration(None, new_run=True)
    assert registry.next_expiry() == LEASE_S
    assert registry.expire(LEASE_S - 0.01) == []
    assert [gone.name for gone in registry.expire(LEASE_S)] == [ROBOT]
    assert registry.get(ROBOT) is None
    assert registry.removal_reason(ROBOT) is RemovalReason.LEASE_EXPIRED
    assert registry.counters.departed[RemovalReason.LEASE_EXPIRED] == 1
    assert registry.next_expiry() is None


def test_every_message_renews_the_lease(registry: Registry) -> None:
    registry.register(registration("robot"), stream(1), 0.0)
    for now in (2.0, 4.0, 6.0, 8.0):
        assert registry.touch(ROBOT, stream(1), now)
        assert registry.expire(now) == []
    assert registry.expire(8.0 + LEASE_S - 0.01) == []
    assert len(registry.expire(8.0 + LEASE_S)) == 1


def test_losing_the_stream_keeps_the_sidecar_until_its_lease_ends(registry: Registry) -> None:
    registry.register(registration("robot"), stream(1), 0.0)
    registry.set_candidates(ROBOT, CandidateSet(interfaces("wlan0")))
    assert registry.disconnect(ROBOT, stream(1)) is None
    known = registry.get(ROBOT)
    assert known is not None
    assert known.stream is None
    assert registry.register(registration("robot"), stream(2), 1.0) == AcceptedRegistration(None, new_run=False)
    again = registry.get(ROBOT)
    assert again is not None
    assert again.candidates == interfaces("wlan0")


def test_who_drained_has_left_when_its_stream_ends(registry: Registry) -> None:
    registry.register(registration("robot"), stream(1), 0.0)
    assert registry.set_draining(ROBOT)
    assert not registry.set_draining(ROBOT)
    assert registry.disconnect(ROBOT, stream(1)) is RemovalReason.LEFT
    assert registry.get(ROBOT) is None
    assert registry.removal_reason(ROBOT) is RemovalReason.LEFT


@pytest.mark.audit("sec-5")
def test_addresses_signed_by_the_run_before_are_not_told_under_the_credential_of_the_next(registry: Registry) -> None:
    """Peers would have to refuse them; they go on with what they have until the new run has signed its own."""
    for incarnation, told in ((1, b"first"), (2, b"second")):
        credential = bytes([incarnation])
        said = replace(registration("robot", incarnation=incarnation), credential=credential)
        registry.register(said, stream(incarnation), 0.0)
        known = registry.get(ROBOT)
        assert known is not None
        assert (known.as_peer().candidates, known.as_peer().candidates_signature) == ((), b"")
        registry.set_candidates(ROBOT, CandidateSet(interfaces("wlan0"), (), incarnation, told))
        known = registry.get(ROBOT)
        assert known is not None
        assert known.candidates == interfaces("wlan0"), "for the mapping they are what they were"
        peer = known.as_peer()
        assert (peer.candidates, peer.candidates_serial, peer.candidates_signature) == (
            interfaces("wlan0"), incarnation, told,
        )  # fmt: skip


def test_a_newer_incarnation_replaces_the_older_stream(registry: Registry) -> None:
    registry.register(registration("robot", incarnation=1), stream(1), 0.0)
    registry.set_candidates(ROBOT, CandidateSet(interfaces("wlan0")))
    registry.set_draining(ROBOT)
    result = registry.register(registration("robot", incarnation=2), stream(2), 1.0)
    assert result == AcceptedRegistration(replaced=stream(1), new_run=True)
    known = registry.get(ROBOT)
    assert known is not None
    # Its peers keep its addresses until it tells new ones, but know its new session at once.
    assert known.candidates == interfaces("wlan0")
    assert known.as_peer().session == registration("robot", incarnation=2).session
    assert known.as_peer().candidates == interfaces("wlan0")
    assert not known.draining
    assert registry.lease_end(ROBOT) == 1.0 + LEASE_S
    assert not registry.touch(ROBOT, stream(1), 2.0)
    assert registry.disconnect(ROBOT, stream(1)) is None
    assert known == registry.get(ROBOT)


def test_a_session_number_belongs_to_one_sidecar(registry: Registry) -> None:
    registry.register(registration("one", session=7), stream(1), 0.0)
    assert registry.register(registration("two", session=7), stream(2), 0.0) is Refusal.SESSION_TAKEN
    registry.register(registration("one", session=8, incarnation=2), stream(3), 0.0)
    assert isinstance(registry.register(registration("two", session=7), stream(2), 0.0), AcceptedRegistration)
    assert registry.register(registration("three", session=8), stream(4), 0.0) is Refusal.SESSION_TAKEN


def test_a_sidecar_is_ready_when_it_told_addresses_and_services(registry: Registry) -> None:
    registry.register(registration("robot"), stream(1), 0.0)
    assert [sidecar.ready for sidecar in registry] == [False]
    assert registry.set_candidates(ROBOT, CandidateSet(()))
    assert [sidecar.ready for sidecar in registry] == [False]
    assert registry.set_services(ROBOT, ServiceSet())
    assert [sidecar.ready for sidecar in registry] == [True]


def test_an_older_incarnation_is_refused(registry: Registry) -> None:
    registry.register(registration("robot", incarnation=2), stream(1), 0.0)
    result = registry.register(registration("robot", incarnation=1), stream(2), 1.0)
    assert result is Refusal.OLDER_INCARNATION
    assert registry.touch(ROBOT, stream(1), 2.0)
    assert registry.counters.refused[Refusal.OLDER_INCARNATION] == 1


def test_a_name_belongs_to_its_token_while_the_lease_lasts(registry: Registry) -> None:
    registry.register(registration("robot"), stream(1), 0.0)
    stranger = registration("robot", incarnation=9, token=b"another sidecar!")
    assert registry.register(stranger, stream(2), 1.0) is Refusal.NAME_TAKEN
    twin = registration("robot", session=99)
    assert registry.register(twin, stream(2), 1.0) is Refusal.NAME_TAKEN
    registry.expire(LEASE_S)
    assert isinstance(registry.register(stranger, stream(2), LEASE_S), AcceptedRegistration)


def test_a_full_registry_refuses_newcomers_and_keeps_the_known(
    registry: Registry, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(registry_module, "MAX_SIDECARS", 2)
    registry.register(registration("a"), stream(1), 0.0)
    registry.register(registration("b"), stream(2), 0.0)
    assert registry.register(registration("c"), stream(3), 0.0) is Refusal.FULL
    assert isinstance(registry.register(registration("b", incarnation=2), stream(4), 0.0), AcceptedRegistration)
    assert {sidecar.name for sidecar in registry} == {"a", "b"}
    assert registry.counters.refused[Refusal.FULL] == 1


def test_who_lost_its_lease_keeps_its_session_number(registry: Registry) -> None:
    """Its peers keep it with that number, which is in clear in each datagram."""
    thief = registration("thief", session=7)
    registry.register(registration("robot", session=7), stream(1), 0.0)
    assert len(registry.expire(LEASE_S)) == 1
    assert registry.register(thief, stream(2), 9.0) is Refusal.SESSION_TAKEN
    again = registry.register(registration("robot", session=7), stream(3), 9.0)
    assert again == AcceptedRegistration(None, new_run=True)
    assert registry.register(thief, stream(2), 9.0) is Refusal.SESSION_TAKEN
    assert len(registry.expire(99.0)) == 1
    registry.register(registration("robot", session=8, incarnation=2), stream(4), 99.0)
    assert isinstance(registry.register(thief, stream(2), 99.0), AcceptedRegistration), "its owner has another one now"


@pytest.mark.parametrize("reason", [one for one in RemovalReason if one is not RemovalReason.LEASE_EXPIRED])
def test_who_is_gone_for_good_gives_its_session_number_back(registry: Registry, reason: RemovalReason) -> None:
    registry.counters.departed.setdefault(reason, 0)
    registry.register(registration("robot", session=7), stream(1), 0.0)
    registry.remove(ROBOT, reason)
    assert isinstance(registry.register(registration("other", session=7), stream(2), 1.0), AcceptedRegistration)


def test_session_numbers_kept_for_the_lost_are_bounded(registry: Registry, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(registry_module, "MAX_REMEMBERED_REMOVALS", 3)
    for number in range(5):
        registry.register(registration(f"robot-{number}", session=10 + number), stream(1), float(number))
    assert len(registry.expire(99.0)) == 5
    assert len(registry._sessions) == 3
    assert isinstance(registry.register(registration("other", session=10), stream(2), 99.0), AcceptedRegistration)


def test_reasons_of_removals_are_bounded(registry: Registry, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(registry_module, "MAX_REMEMBERED_REMOVALS", 3)
    for number in range(5):
        name = f"robot-{number}"
        registry.register(registration(name), stream(number), 0.0)
        registry.set_draining(NodeName(name))
        registry.disconnect(NodeName(name), stream(number))
    assert registry.removal_reason(NodeName("robot-4")) is RemovalReason.LEFT
    assert registry.removal_reason(NodeName("robot-0")) is RemovalReason.LEASE_EXPIRED
    assert registry.counters.removals_forgotten == 2


def test_setters_say_whether_anything_changed(registry: Registry) -> None:
    registry.register(registration("cloud", Role.CLOUD), stream(1), 0.0)
    name = NodeName("cloud")
    assert registry.set_candidates(name, CandidateSet(interfaces("eth0")))
    assert not registry.set_candidates(name, CandidateSet(interfaces("eth0")))
    assert registry.set_services(name, ServiceSet((offer(),)))
    assert not registry.set_services(name, ServiceSet((offer(),)))
    known = registry.get(name)
    assert known is not None
    peer = known.as_peer()
    assert (peer.name, peer.role, peer.candidates, peer.offers) == (
        name,
        Role.CLOUD,
        interfaces("eth0"),
        (offer(),),
    )


def test_coming_and_going_leaves_nothing_behind(registry: Registry) -> None:
    for round_ in range(25):
        registry.register(registration("robot", incarnation=round_), stream(round_), 0.001 * round_)
        registry.set_draining(ROBOT)
        registry.disconnect(ROBOT, stream(round_))
    assert len(registry._ends) == 1
    registry.expire(100.0)
    assert registry.next_expiry() is None


@pytest.mark.audit("ops-16")
def test_who_has_unread_bytes_is_judged_later_but_not_for_ever(registry: Registry) -> None:
    registry.register(registration("robot"), stream(1), 0.0)
    registry.register(registration("other"), stream(2), 0.0)
    late = LEASE_S + 7.0
    assert set(registry.due(late)) == {ROBOT, "other"}
    assert [gone.name for gone in registry.expire(late, {ROBOT})] == ["other"]
    for count in range(1, MAX_POSTPONED):
        assert registry.due(late + (count - 0.1) * POSTPONE_S) == []
        assert registry.expire(late + count * POSTPONE_S, {ROBOT}) == []
    assert registry.postponed.counted == COUNTED_BURST
    assert [gone.name for gone in registry.expire(late + MAX_POSTPONED * POSTPONE_S, {ROBOT})] == [ROBOT]


@pytest.mark.audit("ops-16")
def test_a_word_that_was_read_late_renews_the_lease(registry: Registry) -> None:
    registry.register(registration("robot"), stream(1), 0.0)
    assert registry.expire(LEASE_S + 7.0, {ROBOT}) == []
    assert registry.touch(ROBOT, stream(1), LEASE_S + 7.5)
    assert registry.due(2 * LEASE_S + 7.4) == []
    for count in range(MAX_POSTPONED):
        assert registry.expire(2 * LEASE_S + 7.5 + count * POSTPONE_S, {ROBOT}) == [], "counted from then on"
    assert len(registry.expire(2 * LEASE_S + 7.5 + MAX_POSTPONED * POSTPONE_S, {ROBOT})) == 1


@pytest.mark.audit("ops-16")
def test_looking_at_what_is_due_changes_nothing(registry: Registry) -> None:
    registry.register(registration("robot"), stream(1), 0.0)
    registry.touch(ROBOT, stream(1), 2.0)
    assert registry.due(LEASE_S) == []
    assert registry.next_expiry() == 2.0 + LEASE_S
    assert registry.due(2.0 + LEASE_S) == registry.due(2.0 + LEASE_S) == [ROBOT]
    assert [gone.name for gone in registry.expire(2.0 + LEASE_S)] == [ROBOT]
    assert registry.due(100.0) == []


@pytest.mark.audit("ops-12")
def test_one_that_sends_bytes_and_says_nothing_does_not_look_like_an_overload(registry: Registry) -> None:
    """It registers again whenever its lease has ended, for an hour; the alert looks at five minutes."""
    counts = []
    for second in range(3600):
        now = float(second)
        if registry.get(ROBOT) is None:
            registry.register(registration("robot"), stream(second + 1), now)
        registry.expire(now, {ROBOT})
        counts.append(registry.postponed.counted)
    assert registry.counters.departed[RemovalReason.LEASE_EXPIRED] > 100
    assert max(late - early for early, late in zip(counts, counts[300:], strict=False)) <= ALERT_AT / 2
    for number in range(8):
        registry.register(registration(f"other-{number}"), stream(9000 + number), 3600.0)
    before = registry.postponed.counted
    for second in range(10):
        registry.expire(3606.0 + second, [NodeName(f"other-{number}") for number in range(8)])
    assert registry.postponed.counted > before + ALERT_AT, "eight that are read late do"
