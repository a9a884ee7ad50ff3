from __future__ import annotations

from dataclasses import replace

import pytest

from lab.simulated.sessions import credential_of, session_of
from plr.protos.model.ids import InterfaceName, NodeName, Role, ServiceName, SessionId, Version
from plr.protos.model.mapping import Assignment, MappingSet, ServiceMapping
from plr.protos.model.members import Peer, PeerSet, RemovalReason, RemovedPeer, ServiceOffer, ServiceUse
from plr.protos.model.redundancy_mode import RedundancyMode
from plr.sidecar.core.base.report_scope import ReportScope
from plr.sidecar.core.base.values import PathId, PathState, Priority, RejectReason
from plr.sidecar.core.engine.engine import SWEEP_EVERY_S, Engine, EngineConfig, RemovedCounts
from plr.sidecar.core.engine.removals import MAX_REMOVALS
from plr.sidecar.core.message.reassembly import OVER_REMEMBERED
from plr.sidecar.core.robot.request.service_catalog import WITHDRAW_AFTER_S
from plr.sidecar.core.rules.budget import Budget
from plr.sidecar.core.seam.application import (
    AbandonExecution,
    ApplicationEvent,
    CancelExecution,
    CarriedService,
    ExecuteRequest,
    OfferService,
    RequestFailed,
    ResponseArrived,
    WithdrawService,
)
from plr.sidecar.core.seam.links import (
    FinishedLost,
    FragmentsReceived,
    LinkCommand,
    PathChanged,
    PathMeasured,
    PeerClosed,
    PeerRestarted,
    Send,
    SendFinished,
    SetPeers,
)
from plr.sidecar.core.wire.frame import BASE_SYMBOL_BYTES, Fragment
from plr.sidecar.core.wire.messages import (
    CancelMessage,
    Message,
    RejectionMessage,
    RequestMessage,
    ResponseMessage,
    decode_message,
    encode_message,
)
from tests.support.builders import ECHO, TYPE, WLAN, WWAN, A, B, path, peer, request, request_id, rule

ROBOT = NodeName("robot")


class Sidecar:
    """An engine with one interface, whose peer the test plays."""

    def __init__(self, role: Role, peer_name: str, *, idempotent: bool = True) -> None:
        rules = (rule("/*", idempotent=idempotent),)
        self.engine = Engine(EngineConfig(role, rules), session_of("me", role, 99), 0.0)
        self.engine.set_interfaces([WLAN], 0.0)
        self.path = path(WLAN, peer_name)
        self.number = 0
        self.view(peer(peer_name))
        self.change(PathState.UP)
        self.take()

    def view(self, *peers: Peer, version: int = 1) -> None:
        assert self.engine.apply_peers(PeerSet(Version(version), 1, peers), 0.0) is None

    def change(self, state: PathState, now: float = 0.0) -> None:
        self.engine.on_link_event(PathChanged(self.path, state, ""), now)

    def receive(self, message: Message | bytes, *, session: int = 1, now: float = 0.1) -> None:
        data = message if isinstance(message, bytes) else b"".join(encode_message(message))
        assert len(data) <= BASE_SYMBOL_BYTES
        self.number += 1
        fragment = Fragment(self.number, len(data), BASE_SYMBOL_BYTES, 0, memoryview(data))
        self.engine.on_link_event(FragmentsReceived(self.path, SessionId(session), [fragment]), now)

    def take(self) -> tuple[list[LinkCommand], list[ApplicationEvent]]:
        events = self.engine.take_events()
        for event in events:
            if isinstance(event, ResponseArrived):
                self.engine.robot.requests.judge_answer(event.request_id, event.copy, None, 0.1)
        return [command for _, command in self.engine.take_commands()], events

    def replies(self) -> list[Message]:
        """What is sent to the peer, decoded."""
        sends = [command for command in self.take()[0] if isinstance(command, Send)]
        return [decode_message(memoryview(b"".join(send.message.content))) for send in sends]


def cloud() -> Sidecar:
    sidecar = Sidecar(Role.CLOUD, ROBOT)
    sidecar.engine.cloud.set_offers([ServiceOffer(ECHO, TYPE)])
    return sidecar


def robot() -> Sidecar:
    sidecar = Sidecar(Role.ROBOT, A)
    sidecar.engine.robot.set_carried(frozenset({CarriedService(ECHO)}))
    return sidecar


def test_a_request_is_told_finished_and_handed_to_the_application_and_its_answer_sent() -> None:
    sidecar = cloud()
    sidecar.receive(request())
    commands, (execution,) = sidecar.take()
    assert commands == [SendFinished(sidecar.path, 1, at_once=False)]  # the answer is company
    assert isinstance(execution, ExecuteRequest)
    assert sidecar.engine.busy == 1
    sidecar.engine.cloud.complete(execution.execution, b"answer", 0.5, 0.2)
    assert sidecar.replies() == [ResponseMessage(request_id(1), 0, 0.5, b"answer")]


def test_an_answer_takes_another_path_when_the_requests_own_is_down() -> None:
    sidecar = cloud()
    sidecar.receive(request())
    _, (execution,) = sidecar.take()
    assert isinstance(execution, ExecuteRequest)
    sidecar.engine.set_interfaces([WLAN, WWAN], 0.2)
    other = path(WWAN, ROBOT)
    sidecar.engine.on_link_event(PathChanged(other, PathState.UP, ""), 0.2)
    sidecar.change(PathState.DOWN)
    sidecar.take()
    sidecar.engine.cloud.complete(execution.execution, b"answer", 0.5, 0.2)
    (send,) = sidecar.take()[0]
    assert isinstance(send, Send)
    assert send.path == other


REFUSALS = {
    "no such service": (request(service=ServiceName("/none")), RejectReason.NOT_OFFERED),
    "another type": (
        RequestMessage(request_id(1), 0, Priority.NORMAL, 0.1, 1.0, ECHO, "t/srv/Other", b""),
        RejectReason.WRONG_TYPE,
    ),
}


@pytest.mark.parametrize("kind", REFUSALS)
def test_requests_that_cannot_run_are_refused_with_the_reason(kind: str) -> None:
    message, reason = REFUSALS[kind]
    sidecar = cloud()
    sidecar.receive(message)
    (reply,) = sidecar.replies()
    assert isinstance(reply, RejectionMessage)
    assert reply.reason is reason


def test_a_draining_cloud_refuses_the_new_and_answers_the_old() -> None:
    sidecar = cloud()
    sidecar.receive(request(1))
    _, (execution,) = sidecar.take()
    assert isinstance(execution, ExecuteRequest)
    sidecar.engine.drain()
    sidecar.receive(request(2))
    sidecar.receive(request(1, copy=1))
    (refused,) = sidecar.replies()
    assert isinstance(refused, RejectionMessage)
    assert refused.reason is RejectReason.DRAINING
    sidecar.engine.cloud.complete(execution.execution, b"", 0.0, 0.3)
    assert len(sidecar.replies()) == 2


def test_messages_of_the_wrong_direction_or_broken_ones_are_dropped_and_counted() -> None:
    for sidecar, message, reason in (
        (robot(), request(), "request_to_a_robot"),
        (robot(), CancelMessage(request_id(1)), "cancel_to_a_robot"),
        (cloud(), ResponseMessage(request_id(1), 0, 0.0, b""), "response_to_a_cloud"),
        (cloud(), b"\xff" * 40, "unknown_message"),
        (robot(), b"", "malformed_message"),
    ):
        sidecar.receive(message)
        assert sidecar.engine.stats.dropped == {reason: 1}
        commands, events = sidecar.take()
        assert [type(command) for command in commands] == [SendFinished]
        assert events == []


def test_a_cancel_stops_what_has_not_started_and_what_is_being_sent() -> None:
    sidecar = cloud()
    sidecar.receive(request(1))
    sidecar.receive(request(2))
    _, executions = sidecar.take()
    first, second = (event for event in executions if isinstance(event, ExecuteRequest))
    sidecar.engine.cloud.complete(first.execution, b"answer", 0.1, 0.2)
    assert sidecar.engine.busy == 2
    for number in (1, 2, 1, 2, 3):
        sidecar.receive(CancelMessage(request_id(number)))
    assert sidecar.take()[1] == [CancelExecution(second.execution, second.robot)]
    assert sidecar.engine.busy == 0, "nobody waits for what runs, and the answer is not sent any more"
    sidecar.engine.cloud.refuse(second.execution, RejectReason.CANCELLED, "", 0.3)
    sidecar.receive(request(3))
    assert sidecar.take()[1] == []
    assert sidecar.engine.busy == 0


def test_fragments_of_a_session_that_is_over_are_dropped() -> None:
    sidecar = cloud()
    sidecar.receive(request(), session=2)
    sidecar.engine.on_link_event(PeerRestarted(ROBOT, credential_of(ROBOT, Role.CLOUD, 2, 2), at_home=True), 0.1)
    sidecar.receive(request(), session=1)
    assert sidecar.engine.stats.dropped["fragment_of_old_session"] == 2
    sidecar.take()
    sidecar.number = 0
    sidecar.receive(request(), session=2)
    assert [type(event) for event in sidecar.take()[1]] == [ExecuteRequest]


def test_news_of_paths_to_peers_or_over_interfaces_that_are_gone_leave_no_trace() -> None:
    sidecar = robot()
    known = dict(sidecar.engine.routes._routes)
    for stray in (path(WLAN, "gone"), path("eth9", A)):
        sidecar.engine.on_link_event(PathMeasured(stray, 0.1, (0.1,), 1, 0), 0.1)
        sidecar.engine.on_link_event(PathChanged(stray, PathState.UP, ""), 0.1)
    assert sidecar.engine.routes._routes == known
    assert len(sidecar.engine.take_report(0.2).paths) == 1


def test_the_same_news_of_a_path_twice_costs_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    sidecar = robot()
    looked_at: list[PathState] = []
    requests = sidecar.engine.robot.requests
    monkeypatch.setattr(requests, "on_path_changed", lambda _path, state, _now: looked_at.append(state))
    for state in (PathState.UNSTABLE, PathState.UNSTABLE, PathState.DOWN, PathState.DOWN, PathState.UP):
        sidecar.change(state)
    assert looked_at == [PathState.UNSTABLE, PathState.DOWN, PathState.UP]


def test_the_robot_offers_what_a_reachable_cloud_offers_and_says_what_it_carries() -> None:
    engine = Engine(EngineConfig(Role.ROBOT, (rule(ECHO),)), session_of("me", Role.ROBOT, 99), 0.0)
    engine.set_interfaces([WLAN], 0.0)
    engine.apply_peers(PeerSet(Version(1), 1, (peer(A),)), 0.0)
    assert engine.take_events() == []
    engine.on_link_event(PathChanged(path(), PathState.UP, ""), 0.1)
    assert engine.take_events() == [OfferService(ECHO, TYPE)]
    assert engine.uses() == ()
    engine.robot.set_carried(frozenset({CarriedService(ECHO)}))
    assert engine.uses() == (ServiceUse(ECHO, TYPE, 0.1, idempotent=True),)
    engine.robot.set_carried(frozenset({CarriedService(ECHO, fallback_up=True)}))
    assert engine.uses() == (ServiceUse(ECHO, TYPE, 0.1, idempotent=True, fallback_up=True),)


def test_it_says_once_that_offers_or_uses_may_have_changed() -> None:
    engine = Engine(EngineConfig(Role.ROBOT, (rule(ECHO),)), session_of("me", Role.ROBOT, 99), 0.0)
    carried = frozenset({CarriedService(ECHO, fallback_up=True)})
    engine.robot.set_carried(carried)
    assert [engine.take_services_changed() for _ in range(2)] == [True, False]
    engine.set_interfaces([WLAN], 0.0)
    engine.apply_peers(PeerSet(Version(1), 1, (peer(A),)), 0.0)
    assert not engine.take_services_changed(), "no path leads to the server"
    engine.on_link_event(PathChanged(path(), PathState.UP, ""), 0.1)
    assert [engine.take_services_changed() for _ in range(2)] == [True, False], "its fallback brought it up before"
    engine.on_link_event(PathChanged(path(), PathState.DOWN, ""), 0.2)
    engine.handle_timer(0.1 + WITHDRAW_AFTER_S)
    assert not engine.take_services_changed(), "it may come back"
    engine.handle_timer(0.2 + WITHDRAW_AFTER_S)
    assert engine.take_events()[-1:] == [WithdrawService(ECHO, "no path to a server for 15 s")]
    assert [engine.take_services_changed() for _ in range(2)] == [True, False]
    other = cloud().engine
    assert [other.take_services_changed() for _ in range(2)] == [True, False]


@pytest.mark.audit("ops-12")
def test_the_robot_says_how_its_copies_are_sent() -> None:
    hedged = replace(rule(ECHO), redundancy=RedundancyMode.HEDGE, hedge_quantile=0.9)
    for budget, limited in ((Budget("w*"), False), (Budget("w*", extra_load=0.1), True)):
        engine = Engine(EngineConfig(Role.ROBOT, (hedged,), (budget,)), session_of("me", Role.ROBOT, 99), 0.0)
        engine.set_interfaces([WLAN], 0.0)
        engine.apply_peers(PeerSet(Version(1), 1, (peer(A),)), 0.0)
        engine.on_link_event(PathChanged(path(), PathState.UP, ""), 0.1)
        engine.robot.set_carried(frozenset({CarriedService(ECHO)}))
        (told,) = engine.uses()
        assert (told.redundancy, told.hedge_quantile, told.budgeted) == (RedundancyMode.HEDGE, 0.9, limited)


@pytest.mark.audit("dp-14")
def test_a_request_for_a_service_that_is_not_offered_fails_at_once() -> None:
    sidecar = robot()
    sidecar.engine.robot.requests.submit(request_id(1), ServiceName("/none"), b"", 0.1)
    (failed,) = sidecar.take()[1]
    assert isinstance(failed, RequestFailed)
    assert failed.outcome == "rejected"
    assert sidecar.engine.stats.requests[ServiceName("/none"), "rejected"] == 1
    (told,) = sidecar.engine.take_report(0.2).outcomes
    assert (told.service, told.failed) == ("/none", 1), "the control plane learns of it as of any other"


def test_a_goodbye_ends_the_requests_there_and_leaves_nothing_in_the_outbox() -> None:
    sidecar = robot()
    sidecar.engine.robot.requests.submit(request_id(1), ECHO, b"", 0.1)
    assert sidecar.engine.busy == 2
    sidecar.engine.on_link_event(PeerClosed(A, SessionId(1)), 0.2)
    assert len(sidecar.engine._outbox) == 0
    assert not sidecar.engine.routes.reaches(A)


@pytest.mark.audit("ops-11")
def test_a_goodbye_is_reported_until_the_control_plane_lists_the_server_no_more_and_once_after() -> None:
    """One that was away when it was said hears of it before its own view tells what it knows."""
    sidecar = robot()
    sidecar.engine.on_link_event(PeerClosed(A, SessionId(1)), 0.2)
    assert [sidecar.engine.take_report(0.3).goodbyes for _ in range(2)] == [(A,), (A,)]
    sidecar.view(version=2)
    assert [sidecar.engine.take_report(0.4).goodbyes for _ in range(2)] == [(A,), ()]


@pytest.mark.audit("ops-11")
def test_a_server_that_is_back_has_said_no_goodbye() -> None:
    sidecar = robot()
    sidecar.engine.on_link_event(PeerClosed(A, SessionId(1)), 0.2)
    sidecar.view(peer(A, session=2, incarnation=2), version=2)
    assert sidecar.engine.take_report(0.3).goodbyes == ()
    sidecar.change(PathState.UP)
    sidecar.engine.on_link_event(PeerClosed(A, SessionId(2)), 0.4)
    sidecar.change(PathState.UP)
    assert sidecar.engine.take_report(0.5).goodbyes == ()


def test_a_cloud_that_drains_waits_only_for_what_is_awaited() -> None:
    """A local server that died holds its requests for long; their robots may have had their answers from another."""
    sidecar = cloud()
    for number in (1, 2):
        sidecar.receive(request(number))
    sidecar.receive(CancelMessage(request_id(1)))
    assert sidecar.engine.busy == 1
    sidecar.take()
    sidecar.engine.on_link_event(PeerClosed(ROBOT, SessionId(1)), 0.2)
    _, events = sidecar.take()
    assert [type(event) for event in events] == [CancelExecution]
    assert sidecar.engine.busy == 0


def dormant(sidecar: Sidecar) -> list[NodeName]:
    """The dormant peers that links know, as they were given last."""
    told = [command for command in sidecar.take()[0] if isinstance(command, SetPeers)]
    return [peer.name for peer in told[-1].peers if peer.dormant] if told else []


def test_a_peer_kept_only_for_its_paths_is_dormant_after_the_last_of_them() -> None:
    for goes in (PathChanged(path(), PathState.DOWN, ""), PeerClosed(A, SessionId(1))):
        sidecar = robot()
        sidecar.view(version=2)
        assert A in sidecar.engine.peers
        sidecar.take()
        sidecar.engine.on_link_event(goes, 0.2)
        assert A not in sidecar.engine.peers
        assert not dormant(sidecar), "one that comes and goes costs links no work each time"
        sidecar.engine.handle_timer(0.2 + SWEEP_EVERY_S)
        assert dormant(sidecar) == [A]


def silent_cloud() -> Sidecar:
    """A cloud whose robot asked something, left the view, and fell silent."""
    sidecar = cloud()
    sidecar.receive(request(1))
    sidecar.view(version=2)
    sidecar.change(PathState.DOWN, 0.2)
    assert ROBOT not in sidecar.engine.peers
    sidecar.take()
    return sidecar


def test_a_dormant_peer_is_a_peer_again_when_a_path_to_it_lives() -> None:
    sidecar = silent_cloud()
    sidecar.engine.on_link_event(PathChanged(path(WWAN, ROBOT), PathState.UP, ""), 1.0)
    assert ROBOT not in sidecar.engine.peers, "we have no such interface"
    sidecar.change(PathState.UP, 1.0)
    assert ROBOT in sidecar.engine.peers
    assert not sidecar.engine.cloud._away
    sidecar.receive(request(3))
    assert [type(event) for event in sidecar.take()[1]] == [ExecuteRequest]
    sidecar.engine.handle_timer(9.0)
    (told,) = (command for command in sidecar.take()[0] if isinstance(command, SetPeers))
    assert not told.peers[0].dormant


def test_an_unlisted_peer_that_comes_and_goes_all_the_time_makes_links_no_work() -> None:
    sidecar = silent_cloud()
    for _ in range(1000):
        sidecar.change(PathState.UP, 0.5)
        assert ROBOT in sidecar.engine.peers
        sidecar.engine.on_link_event(PeerClosed(ROBOT, SessionId(1)), 0.5)
        assert sidecar.engine.peers.is_dormant(ROBOT)
    sidecar.engine.handle_timer(SWEEP_EVERY_S)
    assert sum(isinstance(command, SetPeers) for command in sidecar.take()[0]) == 1


def test_a_removed_peer_is_told_with_the_reason_and_what_is_kept_of_it() -> None:
    sidecar = robot()
    expired = RemovedPeer(A, RemovalReason.LEASE_EXPIRED)

    def told(now: float) -> list[tuple[float, str | None]]:
        found = sidecar.engine.removed_peers(now - 60.0, 9)
        assert all((one.name, one.removal.reason) == (A, expired.reason) for one in found)
        return [(one.removal.at, one.kept) for one in found]

    assert sidecar.engine.apply_peers(PeerSet(Version(2), 1, (), (expired,)), 3.0) is None
    assert told(10.0) == [(3.0, "path")]
    sidecar.change(PathState.DOWN, 4.0)
    assert told(10.0) == told(9000.0) == [(3.0, "dormant")]
    assert sidecar.engine.removed_peers(9000.0, 9)[0].removal.dormant_at == 4.0
    assert sidecar.engine.apply_peers(PeerSet(Version(3), 1, (peer(A),)), 5.0) is None
    assert told(10.0) == []


def test_all_removed_peers_are_counted_whether_or_not_their_reasons_are_remembered() -> None:
    many = [peer(NodeName(f"n{number}"), session=number + 10) for number in range(MAX_REMOVALS + 100)]
    sidecar = cloud()
    sidecar.view(peer(ROBOT), *many, version=2)
    expired = (RemovedPeer(ROBOT, RemovalReason.LEASE_EXPIRED),)
    assert sidecar.engine.apply_peers(PeerSet(Version(3), 1, (), expired), 3.0) is None
    assert sidecar.engine.removed_counts(0.0) == RemovedCounts(1, len(many), 0, at_least=False)
    before = sidecar.engine.removals.latest()
    assert sidecar.engine.apply_peers(PeerSet(Version(4), 1, ()), 9.0) is None
    assert sidecar.engine.removals.latest() == before, "a forgotten removal does not begin again"
    assert {one.removal.dormant_at for one in sidecar.engine.removed_peers(0.0, 9)} == {3.0}
    left = tuple(RemovedPeer(NodeName(f"n{number}"), RemovalReason.LEFT) for number in range(1000, 1010))
    assert sidecar.engine.apply_peers(PeerSet(Version(5), 1, (), left), 12.0) is None
    assert sidecar.engine.removed_counts(10.0)[:3] == (1, len(many) - 10, 10)
    assert sidecar.engine.removed_counts(12.0)[:3] == (1, len(many) - 10, 0)


def test_paths_of_a_peer_that_goes_at_once_end_with_the_reason() -> None:
    sidecar = robot()
    left = RemovedPeer(A, RemovalReason.LEFT)
    assert sidecar.engine.apply_peers(PeerSet(Version(2), 1, (), (left,)), 3.0) is None
    (told,) = (command for command in sidecar.take()[0] if isinstance(command, SetPeers))
    assert told == SetPeers((), {A: "removed by the control plane: it was stopped"})
    assert [(one.removal.at, one.kept) for one in sidecar.engine.removed_peers(0.0, 9)] == [(3.0, None)]
    assert not sidecar.engine.removed_peers(3600.0, 9)


def test_a_dormant_robot_may_come_back_in_a_later_session() -> None:
    sidecar = silent_cloud()
    credential = credential_of(ROBOT, Role.CLOUD, 2, 2)
    sidecar.engine.on_link_event(PeerRestarted(ROBOT, credential, at_home=True), 1.0)
    assert ROBOT not in sidecar.engine.peers
    commands, events = sidecar.take()
    assert [type(event) for event in events] == [CancelExecution]
    assert [one.session for command in commands if isinstance(command, SetPeers) for one in command.peers] == [2]
    sidecar.change(PathState.UP, 2.0)
    assert sidecar.engine.peers.session(ROBOT) == 2


def test_a_flood_of_restarts_makes_little_work() -> None:
    sidecar = cloud()
    for incarnation in range(2, 1000):
        credential = credential_of(ROBOT, Role.CLOUD, incarnation, incarnation)
        sidecar.engine.on_link_event(PeerRestarted(ROBOT, credential, at_home=True), 0.001 * incarnation)
    assert len([command for command in sidecar.take()[0] if isinstance(command, SetPeers)]) == 1


@pytest.mark.audit("ops-16")
def test_what_a_mapping_of_the_run_before_rests_on_says_which_type_a_service_has() -> None:
    """The rogue one comes first in each order: of the alphabet, of peers, of paths."""
    engine = Engine(EngineConfig(Role.ROBOT, (rule("/*"),)), session_of("me", Role.ROBOT, 99), 0.0)
    engine.set_interfaces([WLAN], 0.0)
    peers = (peer(A, offers=(ServiceOffer(ECHO, "a/srv/A"),)), peer(B, session=2))
    assert engine.apply_peers(PeerSet(Version(1), 1, peers), 0.0) is None
    mapped = ServiceMapping(ECHO, (Assignment(WLAN, B),))
    assert engine.apply_mapping(MappingSet(Version(1), 1, (mapped,))) is None
    assert engine.apply_mapping(MappingSet(Version(2), 1, ())) is None, "as a robot that restarted is told first"
    for server in (A, B):
        engine.on_link_event(PathChanged(path(WLAN, server), PathState.UP, ""), 0.1)
    offered = [event for event in engine.take_events() if isinstance(event, OfferService)]
    assert offered == [OfferService(ECHO, TYPE)]


def test_versions_and_refusals_are_counted() -> None:
    sidecar = robot()
    sidecar.view(peer(A), version=5)
    same = (peer(A, session=7), peer(B, session=7))
    assert sidecar.engine.apply_peers(PeerSet(Version(6), 1, same), 0.0)
    bad = ServiceMapping(ECHO, (Assignment(InterfaceName("eth9"), A),))
    assert sidecar.engine.apply_mapping(MappingSet(Version(3), 1, (bad,)))
    good = ServiceMapping(ECHO, (Assignment(WLAN, A),))
    assert sidecar.engine.apply_mapping(MappingSet(Version(4), 1, (good,))) is None
    stats = sidecar.engine.stats
    assert (stats.peers_version, stats.mapping_version, stats.nacks) == (5, 4, 2)
    assert sidecar.engine.service_mappings == (good,)


def test_timers_always_move_on() -> None:
    for sidecar in (robot(), cloud()):
        if sidecar.path.peer == ROBOT:
            sidecar.receive(request(lifetime_s=3.0))
        else:
            sidecar.engine.robot.requests.submit(request_id(1), ECHO, b"", 0.1)
            sidecar.change(PathState.DOWN, 0.15)
        now, turns = 0.15, 0
        while now < 30.0:
            timer = sidecar.engine.next_timer()
            assert timer > now, "the timer spins"
            now = timer
            sidecar.engine.handle_timer(now)
            turns += 1
        assert turns <= 30.0 / SWEEP_EVERY_S + 5
        assert sidecar.engine.stats.in_flight == 0


def test_an_execution_that_never_answers_is_abandoned() -> None:
    sidecar = cloud()
    sidecar.receive(request(lifetime_s=3.0))
    _, (execution,) = sidecar.take()
    assert isinstance(execution, ExecuteRequest)
    sidecar.engine.handle_timer(3.2)
    assert sidecar.take()[1] == [AbandonExecution(execution.execution, execution.robot)]
    sidecar.engine.cloud.complete(execution.execution, b"late", 3.0, 3.3)
    assert sidecar.replies() == []


def test_an_interface_that_goes_takes_its_routes_along() -> None:
    sidecar = robot()
    sidecar.engine.robot.requests.submit(request_id(1), ECHO, b"", 0.1)
    sidecar.engine.set_interfaces([WWAN], 0.2)
    assert not sidecar.engine.routes.reaches(A)
    sidecar.take()
    sidecar.engine.on_link_event(PathChanged(PathId(WWAN, A, path().remote), PathState.UP, ""), 0.3)
    assert sidecar.take()[0], "the request travels over the other interface"


def test_a_finished_that_lost_its_path_takes_another_or_waits_for_one() -> None:
    sidecar = robot()
    sidecar.take()
    sidecar.engine.on_link_event(FinishedLost(sidecar.path, (7,)), 0.1)
    assert sidecar.take()[0] == [SendFinished(sidecar.path, 7)]
    sidecar.change(PathState.DOWN)
    sidecar.engine.on_link_event(FinishedLost(sidecar.path, (7, 8)), 0.2)
    assert [item for item in sidecar.take()[0] if isinstance(item, SendFinished)] == []
    for expected in ([SendFinished(sidecar.path, 7), SendFinished(sidecar.path, 8)], []):
        sidecar.change(PathState.UP)
        assert [item for item in sidecar.take()[0] if isinstance(item, SendFinished)] == expected
        sidecar.change(PathState.DOWN)


def test_what_a_peer_could_not_be_told_is_bounded_and_ends_with_its_session() -> None:
    sidecar = robot()
    sidecar.change(PathState.DOWN)
    sidecar.engine.on_link_event(FinishedLost(sidecar.path, tuple(range(OVER_REMEMBERED + 5))), 0.2)
    assert sidecar.engine.stats.dropped["finished_untold"] == 5
    sidecar.engine.on_link_event(FinishedLost(path(WLAN, "stranger"), (1,)), 0.2)
    assert len(sidecar.engine._inbound._untold) == 1
    sidecar.view(peer(A, session=2), version=2)
    assert not sidecar.engine._inbound._untold


@pytest.mark.audit("ops-18")
def test_a_path_that_goes_or_comes_is_urgent_to_a_robot() -> None:
    sidecar = robot()
    sidecar.engine.take_report(1.0)
    assert not sidecar.engine.take_urgency()
    for state in (PathState.DOWN, PathState.UP):
        sidecar.change(state, 1.0)
        assert sidecar.engine.take_urgency()
        assert not sidecar.engine.take_urgency()
        sidecar.engine.take_report(1.0)
    sidecar.change(PathState.UP, 2.0)
    assert not sidecar.engine.take_urgency(), "no news"
    sidecar.change(PathState.DOWN, 3.0)
    assert sidecar.engine.take_urgency() is ReportScope.CHANGES
    told = sidecar.engine.take_report(3.0, ReportScope.CHANGES)
    assert told.changes_only
    assert [report.up for report in told.paths] == [False]
    assert sidecar.engine.take_report(3.0, ReportScope.CHANGES).paths == ()
    other = cloud()
    other.change(PathState.DOWN, 1.0)
    assert not other.engine.take_urgency()
