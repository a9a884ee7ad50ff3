"""What ends with a session or an interface, and what does not."""

from __future__ import annotations

import pytest

from lab.simulated.sessions import credential_of
from plr.protos.model.ids import Role, SessionId, Version
from plr.protos.model.members import PeerSet, RemovalReason, RemovedPeer
from plr.sidecar.core.base.values import ExecutionId, PathState
from plr.sidecar.core.robot.request.service_catalog import WITHDRAW_AFTER_S
from plr.sidecar.core.seam.application import CancelExecution, ResponseArrived, WithdrawService
from plr.sidecar.core.seam.links import FragmentsLost, PeerClosed, PeerRestarted, Resend, SetPeers
from plr.sidecar.core.wire.messages import ResponseMessage
from tests.support.builders import ECHO, A, peer, request, request_id
from tests.unit.sidecar.core.engine.test_engine import ROBOT, Sidecar, cloud, robot


def cancelled(sidecar: Sidecar) -> int:
    return sum(isinstance(event, CancelExecution) for event in sidecar.take()[1])


def busy_cloud() -> Sidecar:
    """A robot's request is at the application, or in the queue before it."""
    sidecar = cloud()
    sidecar.receive(request(1))
    sidecar.take()
    return sidecar


@pytest.mark.parametrize(
    ("reason", "ends"),
    [(reason, reason is not RemovalReason.LEASE_EXPIRED) for reason in RemovalReason],
)
def test_what_a_robot_left_in_the_queue_is_not_run_unless_it_may_come_back_for_it(
    reason: RemovalReason, ends: bool
) -> None:
    sidecar = busy_cloud()
    sidecar.change(PathState.DOWN)
    removed = (RemovedPeer(ROBOT, reason),)
    assert sidecar.engine.apply_peers(PeerSet(Version(2), 1, (), removed), 1.0) is None
    assert cancelled(sidecar) == ends


def test_a_restart_ends_what_was_asked_before_whoever_tells_of_it() -> None:
    sidecar = busy_cloud()
    sidecar.view(peer(ROBOT, session=2, incarnation=2), version=2)
    assert cancelled(sidecar) == 1
    sidecar = busy_cloud()
    sidecar.engine.on_link_event(PeerRestarted(ROBOT, credential_of(ROBOT, Role.CLOUD, 2, 2), at_home=True), 1.0)
    assert cancelled(sidecar) == 1


def test_a_goodbye_of_a_session_that_is_over_says_nothing_of_the_next() -> None:
    sidecar = robot()
    sidecar.view(peer(A, session=2, incarnation=2), version=2)
    sidecar.change(PathState.UP)
    sidecar.take()
    sidecar.engine.robot.requests.submit(request_id(1), ECHO, b"", 0.1)
    sidecar.engine.on_link_event(PeerClosed(A, SessionId(1)), 0.2)
    assert sidecar.engine.routes.reaches(A)
    sidecar.receive(ResponseMessage(request_id(1), 0, 0.01, b"answer"), session=2)
    assert [type(event) for event in sidecar.take()[1]] == [ResponseArrived]


@pytest.mark.parametrize("told_first", [True, False])
def test_an_interface_that_vanishes_is_as_a_path_that_died(told_first: bool) -> None:
    sidecar = robot()
    if told_first:
        sidecar.change(PathState.DOWN, 1.0)
    sidecar.engine.set_interfaces((), 1.0)
    assert sidecar.engine.next_timer() <= 1.0 + WITHDRAW_AFTER_S
    sidecar.engine.handle_timer(1.0 + WITHDRAW_AFTER_S)
    assert [type(event) for event in sidecar.take()[1]] == [WithdrawService]


def test_a_peer_kept_only_for_its_paths_is_dormant_without_interfaces() -> None:
    sidecar = robot()
    sidecar.view(version=2)
    assert A in sidecar.engine.peers
    sidecar.take()
    sidecar.engine.set_interfaces((), 1.0)
    assert A not in sidecar.engine.peers
    (told,) = (command for command in sidecar.take()[0] if isinstance(command, SetPeers))
    assert [(peer.name, peer.dormant) for peer in told.peers] == [(A, True)]


def answers_under_way(sidecar: Sidecar) -> int:
    return sidecar.engine._outbox.messages_to(ROBOT)


@pytest.fixture
def silent() -> Sidecar:
    """A cloud whose robot was answered, fell silent, and is not in the control plane's view any more."""
    sidecar = busy_cloud()
    sidecar.engine.cloud.complete(ExecutionId(0), b"answer", 0.01, 0.5)
    assert answers_under_way(sidecar) == 1
    sidecar.change(PathState.DOWN)
    (answer,) = sidecar.engine._outbox._messages.values()
    sidecar.engine.on_link_event(FragmentsLost(answer.path, answer.symbols, (0,)), 0.9)
    sidecar.view(version=2)
    assert ROBOT not in sidecar.engine.peers
    return sidecar


@pytest.mark.audit("dp-10")
def test_answers_under_way_wait_for_a_robot_that_is_back_with_its_session(silent: Sidecar) -> None:
    assert answers_under_way(silent) == 1
    silent.view(peer(ROBOT), version=3)
    assert answers_under_way(silent) == 1
    silent.take()
    silent.change(PathState.UP, 2.0)
    assert [command.indices for command in silent.take()[0] if isinstance(command, Resend)] == [(0,)]


@pytest.mark.audit("dp-10")
@pytest.mark.parametrize("how", ["restarted", "left"])
def test_they_go_when_that_session_is_over(silent: Sidecar, how: str) -> None:
    if how == "restarted":
        silent.view(peer(ROBOT, session=2, incarnation=2), version=3)
    else:
        removed = (RemovedPeer(ROBOT, RemovalReason.LEFT),)
        assert silent.engine.apply_peers(PeerSet(Version(3), 1, (), removed), 1.0) is None
    assert answers_under_way(silent) == 0
    assert not silent.engine.cloud._away
