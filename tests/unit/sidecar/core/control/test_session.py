from __future__ import annotations

import itertools
import random
from collections import Counter
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from plr.protos.base.histogram import Histogram
from plr.protos.model.ids import (
    MAX_VERSION,
    PROTOCOL_VERSION,
    InterfaceId,
    InterfaceName,
    NodeName,
    Role,
    ServiceName,
    SessionId,
    Version,
)
from plr.protos.model.mapping import MappingSet
from plr.protos.model.members import (
    Candidate,
    CandidateKind,
    CandidateSet,
    PeerSet,
    Registration,
    ServiceOffer,
    ServiceSet,
)
from plr.protos.model.report import OutcomeReport, PathReport, Report
from plr.protos.model.stream import Ack, Drain, Heartbeat, Nack, ResourceKind, SidecarMessage, Welcome
from plr.sidecar.core.base.report_scope import ReportScope
from plr.sidecar.core.control.session import (
    MIN_INTERVAL_S,
    PATIENCE_TIMES,
    RETRY_FIRST_S,
    RETRY_MAX_S,
    STABLE_AFTER_S,
    WELCOME_TIMEOUT_MAX_S,
    WELCOME_TIMEOUT_S,
    Apply,
    ControlSession,
    ControlState,
)

WELCOME = Welcome(lease_s=3.0, report_interval_s=0.5, stun_servers=("192.0.2.9:3478",))
CANDIDATES = CandidateSet((Candidate(InterfaceId(0), InterfaceName("wlan0"), CandidateKind.HOST, ("192.0.2.2", 1)),))
SERVICES = ServiceSet(offers=(ServiceOffer(ServiceName("/plan"), "nav_msgs/srv/GetPlan"),))
REPORT = Report(outcomes=(OutcomeReport(ServiceName("/plan"), ok=3),))


def make_session(peers: int = 0, mapping: int = 0, seed: int = 1) -> ControlSession:
    registration = Registration(
        PROTOCOL_VERSION,
        NodeName("robot-1"),
        Role.ROBOT,
        SessionId(7),
        bytes(16),
        incarnation=3,
        software_version="0",
        peers_version=Version(peers),
        mapping_version=Version(mapping),
    )
    return ControlSession(registration, random.Random(seed))


def online(session: ControlSession, now: float = 0.0) -> ControlSession:
    session.opened(now)
    session.messages_to_send(now)
    session.receive(WELCOME, now)
    session.messages_to_send(now)
    return session


def peers(version: int, nonce: int = 1) -> PeerSet:
    return PeerSet(Version(version), nonce)


def mapping(version: int, nonce: int = 1) -> MappingSet:
    return MappingSet(Version(version), nonce)


def answer(session: ControlSession, now: float = 0.0) -> SidecarMessage:
    (message,) = session.messages_to_send(now)
    return message


def test_a_stream_starts_with_the_registration_and_once_welcome_says_everything_we_are() -> None:
    session = make_session(peers=4, mapping=5)
    session.set_candidates(CANDIDATES)
    session.set_services(SERVICES)
    session.opened(0.0)
    registration = answer(session)
    assert isinstance(registration, Registration)
    assert (registration.peers_version, registration.mapping_version) == (4, 5)
    assert session.messages_to_send(0.0) == []
    session.receive(WELCOME, 0.0)
    assert session.messages_to_send(0.0) == [CANDIDATES, SERVICES]
    assert session.messages_to_send(0.0) == []


def test_nothing_is_sent_offline_and_the_newest_sets_on_the_next_stream() -> None:
    session = make_session()
    session.set_candidates(CANDIDATES)
    assert session.messages_to_send(0.0) == []
    session.opened(1.0)
    session.messages_to_send(1.0)
    session.receive(WELCOME, 1.0)
    assert session.messages_to_send(1.0) == [CANDIDATES, ServiceSet()]
    session.closed(2.0)
    session.set_services(SERVICES)
    session.opened(3.0)
    session.messages_to_send(3.0)
    session.receive(WELCOME, 3.0)
    assert session.messages_to_send(3.0) == [CANDIDATES, SERVICES]


def test_a_changed_set_is_sent_once_and_an_equal_one_not_at_all() -> None:
    session = online(make_session())
    session.set_candidates(CandidateSet())
    assert session.messages_to_send(0.0) == []
    session.set_candidates(CANDIDATES)
    session.set_candidates(CANDIDATES)
    assert session.messages_to_send(0.0) == [CANDIDATES]
    assert session.messages_to_send(0.0) == []


@pytest.mark.audit("ops-3")
def test_addresses_signed_with_a_renewed_certificate_wait_for_the_stream_that_names_it() -> None:
    """Beside the old credential they look like a forgery, to every peer that the control plane relays them to."""
    session = online(make_session())
    session.set_candidates(CANDIDATES)
    assert session.messages_to_send(0.0) == [CANDIDATES]
    session.set_credential(b"renewed")
    signed_again = replace(CANDIDATES, serial=2, signature=b"with the new key")
    session.set_candidates(signed_again)
    session.set_services(SERVICES)
    assert session.messages_to_send(0.0) == [SERVICES]
    session.closed(1.0)
    session.opened(1.0)
    registration = answer(session)
    assert isinstance(registration, Registration)
    assert registration.credential == b"renewed"
    session.receive(WELCOME, 1.0)
    assert session.messages_to_send(1.0) == [signed_again, SERVICES]


@pytest.mark.parametrize("content", [peers(9, nonce=5), mapping(9, nonce=5)])
def test_an_applied_resource_is_acked_with_its_nonce_and_version(content: PeerSet | MappingSet) -> None:
    session = online(make_session())
    event = session.receive(content, 0.0)
    assert isinstance(event, Apply)
    assert event.content is content
    assert session.messages_to_send(0.0) == []
    session.applied(event, None)
    assert answer(session) == Ack(event.resource, Version(9), 5)
    assert session.version(event.resource) == 9


def test_a_refused_resource_is_nacked_with_the_version_still_in_force() -> None:
    session = online(make_session(mapping=4))
    event = session.receive(mapping(5, nonce=8), 0.0)
    assert isinstance(event, Apply)
    session.applied(event, "no interface 'wwan7' here")
    assert answer(session) == Nack(ResourceKind.MAPPING, Version(4), 8, "no interface 'wwan7' here")
    assert session.version(ResourceKind.MAPPING) == 4
    # The same version again, mended or not, is tried again: it was never in force.
    assert isinstance(session.receive(mapping(5, nonce=9), 0.0), Apply)


def test_the_version_in_force_sent_again_is_acked_without_being_applied() -> None:
    session = online(make_session(peers=6))
    assert session.receive(peers(6, nonce=3), 0.0) is None
    assert answer(session) == Ack(ResourceKind.PEERS, Version(6), 3)


@pytest.mark.audit("ops-17")
@pytest.mark.parametrize("version", [MAX_VERSION, 7])
def test_what_one_control_plane_said_binds_no_other(version: int) -> None:
    """The next one, or the same after a restart, may begin with any version."""
    session = online(make_session(peers=version, mapping=version))
    for event in (session.receive(peers(version - 1), 0.0), session.receive(mapping(3), 0.0)):
        assert isinstance(event, Apply)
        session.applied(event, None)
    assert (session.version(ResourceKind.PEERS), session.version(ResourceKind.MAPPING)) == (version - 1, 3)
    assert session.receive(mapping(2), 0.0) is None, "on one stream they only grow"
    session.closed(1.0)
    assert isinstance(online(session, 2.0).receive(mapping(2), 2.0), Apply)


def test_an_older_version_is_refused() -> None:
    session = online(make_session(peers=6))
    assert session.receive(peers(6, nonce=2), 0.0) is None
    assert session.receive(peers(5, nonce=3), 0.0) is None
    nack = answer(session)
    assert isinstance(nack, Nack)
    assert (nack.version, nack.nonce) == (6, 3)
    assert "older" in nack.error
    assert session.stats.ignored["peers_older"] == 1


def test_only_the_newest_answer_waits_however_much_is_pushed() -> None:
    session = online(make_session())
    for version in range(1, 1000):
        for content in (peers(version, nonce=version), mapping(version, nonce=version)):
            event = session.receive(content, 0.0)
            assert isinstance(event, Apply)
            session.applied(event, None)
    assert session.messages_to_send(0.0) == [
        Ack(ResourceKind.PEERS, Version(999), 999),
        Ack(ResourceKind.MAPPING, Version(999), 999),
    ]


def test_an_undecodable_resource_is_nacked_as_far_as_it_can_be_read() -> None:
    session = online(make_session(peers=2))
    session.undecodable(None, 0, "no known kind")
    assert session.messages_to_send(0.0) == []
    session.undecodable(ResourceKind.PEERS, 11, "port 0")
    assert answer(session) == Nack(ResourceKind.PEERS, Version(2), 11, "port 0")


def test_a_new_stream_says_what_is_held_by_now_and_forgets_old_nonces() -> None:
    session = online(make_session())
    event = session.receive(peers(7, nonce=4), 0.0)
    assert isinstance(event, Apply)
    session.applied(event, None)
    session.closed(1.0)
    session.opened(2.0)
    first = answer(session, 2.0)
    assert isinstance(first, Registration)
    assert first.peers_version == 7
    session.receive(WELCOME, 2.0)
    assert not any(isinstance(message, Ack) for message in session.messages_to_send(2.0))


def test_a_stream_that_moves_is_opened_again_at_once_and_costs_no_patience() -> None:
    session = make_session()
    for number in range(20):
        session.opened(float(number))
        assert session.closed(float(number), moved=True) == 0.0
        assert session.retry_at == float(number)
    session.opened(20.0)
    assert session.closed(20.0) <= RETRY_FIRST_S


def test_a_change_of_the_network_brings_the_next_attempt_forward() -> None:
    session = make_session()
    for _ in range(20):
        session.opened(100.0)
        session.closed(100.0)
    session._retry_at = 110.0
    session.network_changed(100.5)
    assert 101.0 <= session.retry_at <= 101.0 + RETRY_FIRST_S, "not at every change"
    session._retry_at = 110.0
    session.network_changed(105.0)
    assert 105.0 <= session.retry_at <= 105.0 + RETRY_FIRST_S
    sooner = session.retry_at
    session.network_changed(109.0)
    assert session.retry_at == sooner, "never later"
    session.opened(110.0)
    session.network_changed(110.0)
    session.closed(110.0, refused=True)
    refused_until = session.retry_at
    session.network_changed(110.0)
    assert session.retry_at == refused_until, "it would be refused again"


def test_what_the_disk_held_in_vain_is_asked_for_again() -> None:
    session = make_session(peers=4, mapping=5)
    held = Apply(ResourceKind.MAPPING, mapping(5))
    session.not_restored(held)
    session.opened(0.0)
    registration = session.messages_to_send(0.0)[0]
    assert isinstance(registration, Registration)
    assert (registration.peers_version, registration.mapping_version) == (4, 0)
    assert session.refused is held, "it may fit before the control plane is within reach"
    assert isinstance(session.receive(mapping(5), 0.0), Apply)


def test_the_newest_mapping_that_was_refused_is_kept_until_one_is_taken() -> None:
    session = online(make_session())

    def take(message: PeerSet | MappingSet, error: str | None) -> Apply:
        event = session.receive(message, 0.0)
        assert isinstance(event, Apply)
        session.applied(event, error)
        return event

    def kept() -> Apply | None:
        return session.refused

    take(mapping(4), None)
    take(peers(4), "two peers share a session")
    assert kept() is None, "only what others may cure is kept"
    take(mapping(5), "no interface 'wwan0' here")
    newest = take(mapping(6), "no interface 'wwan0' here")
    take(peers(5), None)
    assert kept() is newest
    take(mapping(7), None)
    assert kept() is None


def test_a_mapping_that_is_taken_late_is_no_answer_to_the_control_plane() -> None:
    """It counts the version as refused permanently, and may give the next one any number above what it was told."""
    session = online(make_session(mapping=4))
    event = session.receive(mapping(6), 0.0)
    assert isinstance(event, Apply)
    session.applied(event, "no interface 'wwan0' here")
    assert isinstance(answer(session, 0.0), Nack)
    session.applied_late()
    assert session.refused is None
    assert not any(isinstance(message, Ack | Nack) for message in session.messages_to_send(0.0))
    assert isinstance(session.receive(mapping(5), 0.0), Apply)


def test_heartbeats_fill_the_silence_thrice_a_lease() -> None:
    session = online(make_session())
    sent: list[float] = []
    now = 0.0
    while now < 9.0:
        now = session.next_timer()
        session.handle_timer(now)
        if session.report_due(now):
            session.send_report(Report(), now)
        if session.messages_to_send(now) == [Heartbeat()]:
            sent.append(now)
    assert sent == pytest.approx([1.0 * beat for beat in range(1, len(sent) + 1)])
    assert len(sent) == 9


def test_reports_come_at_their_interval_and_stand_for_heartbeats() -> None:
    session = online(make_session())
    sent: list[tuple[float, SidecarMessage]] = []
    now = 0.0
    while now < 4.9:
        now = session.next_timer()
        session.handle_timer(now)
        if session.report_due(now):
            session.send_report(REPORT, now)
        sent += [(now, message) for message in session.messages_to_send(now)]
    assert [at for at, _ in sent] == pytest.approx([0.5 * count for count in range(1, 11)])
    assert {message for _, message in sent} == {REPORT}


def test_an_absurd_welcome_cannot_make_the_sidecar_spin() -> None:
    session = make_session()
    session.opened(0.0)
    session.receive(Welcome(lease_s=1e-6, report_interval_s=1e-6), 0.0)
    assert session.next_timer() >= MIN_INTERVAL_S


def test_no_report_is_taken_while_offline_or_registering() -> None:
    session = make_session()
    assert not session.report_due(100.0)
    session.opened(0.0)
    assert not session.report_due(100.0)
    session.receive(WELCOME, 100.0)
    assert not session.report_due(100.0)
    assert session.report_due(100.5)


def test_a_report_that_the_stream_did_not_live_to_take_is_counted() -> None:
    session = online(make_session())
    session.send_report(REPORT, 1.0)
    session.closed(1.0)
    assert session.stats.reports_dropped == 1
    assert session.stats.reports == 0


def test_a_stream_without_welcome_is_given_up() -> None:
    session = make_session()
    session.opened(10.0)
    assert session.next_timer() == 10.0 + WELCOME_TIMEOUT_S
    assert not session.welcome_overdue(10.0 + WELCOME_TIMEOUT_S - 0.01)
    assert session.welcome_overdue(10.0 + WELCOME_TIMEOUT_S)
    session.receive(WELCOME, 11.0)
    assert not session.welcome_overdue(100.0)


def test_goodbye_comes_last_and_is_said_again_on_a_later_stream() -> None:
    session = online(make_session())
    session.set_services(SERVICES)
    session.drain()
    session.drain()
    assert session.messages_to_send(0.0) == [SERVICES, Drain()]
    session.closed(0.0)
    session.opened(1.0)
    assert session.messages_to_send(1.0)[-1] == Drain()


def outage(session: ControlSession, start: float, until: float) -> list[float]:
    """Delays while no stream gets a Welcome."""
    delays, now = [], start
    while now < until:
        session.opened(now)
        delays.append(session.closed(now))
        assert session.next_timer() == session.retry_at
        now = session.retry_at
    return delays


@pytest.mark.parametrize("seed", range(20))
def test_delays_during_an_outage_stay_within_their_bounds(seed: int) -> None:
    delays = outage(make_session(seed=seed), 0.0, 600.0)
    for attempt, delay in enumerate(delays):
        assert 0.0 <= delay <= min(RETRY_FIRST_S * 2**attempt, RETRY_MAX_S)
    # The load on a control plane that is away: about one attempt in five seconds.
    assert 70 < len(delays) < 200


def test_a_long_stream_resets_the_backoff_and_a_short_one_does_not() -> None:
    assert max(delay_after_a_stream(seed, lasted=0.1) for seed in range(40)) > RETRY_FIRST_S
    assert max(delay_after_a_stream(seed, lasted=STABLE_AFTER_S) for seed in range(40)) <= RETRY_FIRST_S


def delay_after_a_stream(seed: int, *, lasted: float) -> float:
    session = make_session(seed=seed)
    outage(session, 0.0, 100.0)
    online(session, 200.0)
    return session.closed(200.0 + lasted)


def test_a_refusal_is_not_repeated_at_once() -> None:
    delays = []
    for seed in range(40):
        session = make_session(seed=seed)
        session.opened(0.0)
        delays.append(session.closed(0.0, refused=True))
    assert max(delays) > RETRY_MAX_S / 2
    assert max(delays) <= RETRY_MAX_S


VERSIONS = st.integers(0, 12)
PUSHES = st.lists(st.tuples(st.booleans(), VERSIONS, st.booleans(), st.booleans()), max_size=60)


@given(PUSHES)
def test_versions_only_grow_on_a_stream_and_every_push_gets_its_answer(
    pushes: list[tuple[bool, int, bool, bool]],
) -> None:
    session = online(make_session())
    now = 0.0
    acked: Counter[ResourceKind] = Counter()
    for nonce, (is_peers, version, accept, reconnect) in enumerate(pushes, start=1):
        now += 0.01
        if reconnect:
            session.closed(now)
            online(session, now)
            acked.clear()
        kind = ResourceKind.PEERS if is_peers else ResourceKind.MAPPING
        event = session.receive(peers(version, nonce) if is_peers else mapping(version, nonce), now)
        if isinstance(event, Apply):
            assert version > acked[kind]
            session.applied(event, None if accept else "refused")
        reply = answer(session, now)
        assert isinstance(reply, Ack | Nack)
        assert (reply.resource, reply.nonce) == (kind, nonce)
        assert reply.version == session.version(kind) >= acked[kind]
        assert isinstance(reply, Ack) == (reply.version == version)
        if isinstance(reply, Ack):
            acked[kind] = reply.version
    assert session.state is ControlState.ONLINE


@pytest.mark.audit("ops-18")
def test_what_is_urgent_is_reported_before_it_is_due_but_not_all_the_time() -> None:
    session = make_session()
    session.opened(0.0)
    session.messages_to_send(0.0)
    session.receive(Welcome(lease_s=30.0, report_interval_s=10.0), 0.0)
    session.messages_to_send(0.0)
    assert not session.report_due(5.0)
    session.report_at_once(5.0, ReportScope.ALL)
    assert session.report_due(5.0)
    session.send_report(REPORT, 5.0)
    assert answer(session, 5.0) == REPORT
    session.report_at_once(5.1, ReportScope.ALL)
    assert not session.report_due(5.9)
    assert session.report_due(6.0)
    session.send_report(REPORT, 6.0)
    answer(session, 6.0)
    assert session.next_timer() == 16.0


@pytest.mark.audit("ops-20")
def test_what_is_urgent_does_not_wait_for_having_reported_a_moment_ago() -> None:
    """Of a fleet whose server dies, a tenth has just reported as a matter of routine."""
    session = welcomed(make_session(), 0.0)
    session.send_report(REPORT, 10.0)
    session.messages_to_send(10.0)
    session.report_at_once(10.1, ReportScope.ALL)
    assert session.report_due(10.1)
    session.send_report(REPORT, 10.1)
    session.messages_to_send(10.1)
    session.report_at_once(10.2, ReportScope.ALL)
    assert not session.report_due(11.0)
    assert session.report_due(11.1)


def welcomed(session: ControlSession, now: float, interval_s: float = 10.0) -> ControlSession:
    session.opened(now)
    session.messages_to_send(now)
    session.receive(Welcome(lease_s=3 * interval_s, report_interval_s=interval_s), now)
    session.messages_to_send(now)
    return session


@pytest.mark.audit("ops-18")
@pytest.mark.parametrize("interval_s", [0.5, 10.0])
@pytest.mark.parametrize("scope", list(ReportScope))
def test_a_network_that_flaps_all_the_time_makes_no_more_than_ten_reports_in_an_interval(
    scope: ReportScope, interval_s: float
) -> None:
    session = welcomed(make_session(), 0.0, interval_s)
    session.send_report(REPORT, 0.0)
    session.messages_to_send(0.0)
    told = REPORT if scope is ReportScope.ALL else CHANGES
    reported_at = []
    for tick in range(int(20 * interval_s / 0.05)):
        now = 0.05 * tick
        session.report_at_once(now, scope)
        due = session.report_due(now)
        if due is not None:
            session.send_report(told if due is scope else REPORT, now)
            assert session.messages_to_send(now)
            if due is scope:
                reported_at.append(now)
    least_s = max(interval_s / 10, 0.1)
    assert 20 * interval_s / least_s / 2 < len(reported_at) <= 20 * interval_s / least_s + 1
    assert min(b - a for a, b in itertools.pairwise(reported_at)) >= least_s - 1e-9


CHANGES = Report(
    paths=(PathReport(InterfaceName("wlan0"), NodeName("cloud-1"), False, Histogram()),), changes_only=True
)


@pytest.mark.audit("ops-20")
def test_changes_are_told_at_once_and_the_rest_when_it_is_due() -> None:
    session = welcomed(make_session(), 0.0)
    session.report_at_once(1.0, ReportScope.CHANGES)
    assert session.report_due(1.0) is ReportScope.ALL, "a control plane that knows nothing is told everything first"
    session.send_report(REPORT, 1.0)
    session.messages_to_send(1.0)
    session.report_at_once(4.0, ReportScope.CHANGES)
    assert session.next_timer() == 4.0
    assert session.report_due(4.0) is ReportScope.CHANGES
    session.send_report(CHANGES, 4.0)
    assert CHANGES in session.messages_to_send(4.0)
    session.report_at_once(4.1, ReportScope.CHANGES)
    assert session.report_due(4.9) is None
    assert session.report_due(5.0) is ReportScope.CHANGES
    session.report_at_once(4.2, ReportScope.ALL)
    assert session.report_due(4.9) is None
    assert session.report_due(5.0) is ReportScope.ALL
    session.send_report(REPORT, 5.0)
    session.messages_to_send(5.0)
    assert session.report_due(14.9) is None, "a whole report tells of changes as well"
    session.report_at_once(14.95, ReportScope.CHANGES)
    session.send_report(CHANGES, 14.95)
    session.messages_to_send(14.95)
    assert session.report_due(15.0) is ReportScope.ALL


@pytest.mark.audit("ops-20")
def test_changes_told_into_a_stream_that_then_broke_are_told_again_with_everything() -> None:
    session = welcomed(make_session(), 0.0)
    session.send_report(REPORT, 10.0)
    session.messages_to_send(10.0)
    session.report_at_once(20.0, ReportScope.CHANGES)
    session.send_report(CHANGES, 20.0)
    assert CHANGES in session.messages_to_send(20.0)
    session.closed(22.0)
    welcomed(session, 23.0)
    assert session.report_due(23.0) is ReportScope.ALL


@pytest.mark.audit("ops-18")
def test_what_happens_without_a_stream_is_reported_as_soon_as_there_is_one() -> None:
    session = welcomed(make_session(), 0.0)
    session.send_report(REPORT, 10.0)
    session.messages_to_send(10.0)
    session.closed(20.0)
    session.report_at_once(21.0, ReportScope.ALL)
    assert not session.report_due(21.0)
    welcomed(session, 80.0)
    assert session.report_due(80.0)


@pytest.mark.audit("ops-18")
def test_what_was_reported_into_a_stream_that_then_broke_is_reported_again() -> None:
    session = welcomed(make_session(), 0.0)
    session.report_at_once(20.0, ReportScope.ALL)
    session.send_report(REPORT, 20.0)
    assert REPORT in session.messages_to_send(20.0)
    session.closed(22.0)
    welcomed(session, 23.0)
    assert session.report_due(23.0)


@pytest.mark.audit("ops-18")
def test_a_stream_that_comes_back_brings_no_report_of_its_own() -> None:
    session = welcomed(make_session(), 0.0)
    session.report_at_once(20.0, ReportScope.ALL)
    session.send_report(REPORT, 20.0)
    session.messages_to_send(20.0)
    session.closed(50.0)
    welcomed(session, 51.0)
    assert not session.report_due(60.9)
    assert session.report_due(61.0)


@pytest.mark.audit("ops-18")
def test_another_interval_does_not_put_off_the_report_that_is_due_soon() -> None:
    session = online(make_session())
    session.receive(Welcome(lease_s=30.0, report_interval_s=10.0), 0.4)
    assert session.report_due(0.5)


@pytest.mark.audit("ops-16")
def test_a_fleet_that_is_told_so_comes_back_within_the_time_told_and_waits_for_its_turn() -> None:
    session = make_session()
    session.opened(0.0)
    assert session.next_timer() == WELCOME_TIMEOUT_S
    session.receive(Welcome(lease_s=3.0, report_interval_s=0.5, reconnect_max_s=2.0), 0.0)
    delays = []
    for attempt in range(40):
        session.closed(float(attempt), refused=attempt % 2 == 0)
        delays.append(session.retry_at - attempt)
        session.opened(100.0)
    assert max(delays) <= 2.0 < sum(sorted(delays)[-2:])
    assert session.next_timer() == 100.0 + WELCOME_TIMEOUT_S + PATIENCE_TIMES * 2.0


@pytest.mark.audit("ops-16")
def test_each_stream_without_welcome_is_waited_for_twice_as_long() -> None:
    session = make_session()
    waits, now = [], 0.0
    for _ in range(5):
        session.opened(now)
        waits.append(session.next_timer() - now)
        now = session.next_timer()
        session.closed(now)
    assert waits == [WELCOME_TIMEOUT_S, 2 * WELCOME_TIMEOUT_S, 4 * WELCOME_TIMEOUT_S, *[WELCOME_TIMEOUT_MAX_S] * 2]
    session.network_changed(now)
    session.opened(now)
    assert session.next_timer() == now + WELCOME_TIMEOUT_S
    session.closed(now + WELCOME_TIMEOUT_S)
    session.opened(now)
    session.receive(WELCOME, now)
    session.closed(now)
    session.opened(now)
    assert session.next_timer() == now + WELCOME_TIMEOUT_S


def test_a_stream_that_ends_early_makes_nobody_patient() -> None:
    session = make_session()
    for attempt in range(3):
        session.opened(float(attempt))
        session.closed(attempt + 0.5)
    session.opened(10.0)
    assert session.next_timer() == 10.0 + WELCOME_TIMEOUT_S


@pytest.mark.audit("ops-18")
def test_new_peers_are_reported_on_soon() -> None:
    session = make_session()
    session.opened(0.0)
    session.messages_to_send(0.0)
    session.receive(Welcome(lease_s=30.0, report_interval_s=10.0), 0.0)
    session.messages_to_send(0.0)
    event = session.receive(peers(5), 2.0)
    assert isinstance(event, Apply)
    assert not session.report_due(2.0)
    session.applied(event, None)
    assert session.report_due(2.0)
