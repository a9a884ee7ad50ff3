"""What is under way between this sidecar and a peer that is dormant."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from lab.simulated.sessions import credential_of
from plr.protos.model.ids import Role, SessionId, Version
from plr.protos.model.members import NO_POLICY, Peer, PeerSet, RemovalReason, RemovedPeer
from plr.sidecar.core.base.values import PathState, Priority
from plr.sidecar.core.seam.application import ExecuteRequest, RequestFailed, ResponseArrived
from plr.sidecar.core.seam.links import (
    FinishedLost,
    FragmentsLost,
    FragmentsReceived,
    PeerLied,
    PeerRestarted,
    Resend,
    Send,
    SendFinished,
)
from plr.sidecar.core.wire.frame import Fragment
from plr.sidecar.core.wire.messages import RequestMessage, ResponseMessage, encode_message
from tests.support.builders import ECHO, TYPE, A, B, peer, request, request_id
from tests.unit.sidecar.core.engine.test_engine import Sidecar, cloud

if TYPE_CHECKING:
    from collections.abc import Callable

WENT_AWAY = f"{A} went away; it may have run the request"


def lose(
    sidecar: Sidecar, *listed: Peer, reason: RemovalReason = RemovalReason.LEASE_EXPIRED, policy: int = NO_POLICY
) -> None:
    """Take a view that does not list the peer any more."""
    removed = (RemovedPeer(sidecar.path.peer, reason),)
    assert sidecar.engine.apply_peers(PeerSet(Version(2), 1, listed, removed, policy), 0.2) is None


def asking() -> Sidecar:
    """A robot that asked its only server something that may run once at most, and whose server is dormant now."""
    sidecar = Sidecar(Role.ROBOT, A, idempotent=False)
    sidecar.engine.robot.requests.submit(request_id(1), ECHO, b"question", 0.1)
    (send,) = (command for command in sidecar.take()[0] if isinstance(command, Send))
    send.message.begun = True
    lose(sidecar)
    sidecar.change(PathState.DOWN, 0.3)
    sidecar.engine.on_link_event(FragmentsLost(sidecar.path, send.message, (0,)), 0.3)
    assert sidecar.engine.peers.is_dormant(A)
    assert not sidecar.take()[1]
    return sidecar


def test_a_request_at_a_server_that_falls_silent_waits_for_its_return() -> None:
    sidecar = asking()
    assert sidecar.engine.busy == 2, "the request, and the message that carries it"
    sidecar.change(PathState.UP, 3.0)
    assert [type(command) for command in sidecar.take()[0]].count(Resend) == 1
    sidecar.receive(ResponseMessage(request_id(1), 0, 0.1, b"answer"))
    assert [type(event) for event in sidecar.take()[1]] == [ResponseArrived]


def has_left(sidecar: Sidecar) -> None:
    lose(sidecar, reason=RemovalReason.LEFT)


def falls_under_another_policy(sidecar: Sidecar) -> None:
    lose(sidecar, policy=8)


def restarts(sidecar: Sidecar) -> None:
    credential = credential_of(A, Role.CLOUD, 2, 2)
    sidecar.engine.on_link_event(PeerRestarted(A, credential, at_home=True), 1.0)


def is_listed_with_a_later_session(sidecar: Sidecar) -> None:
    sidecar.view(peer(A, session=2, incarnation=2), version=3)


def has_lied(sidecar: Sidecar) -> None:
    sidecar.engine.on_link_event(PeerLied(A, SessionId(1)), 1.0)


def test_a_dormant_peer_that_another_policy_ends_is_told_with_that_reason() -> None:
    sidecar = asking()
    assert [(one.removal.reason, one.kept) for one in sidecar.engine.removed_peers(0.0, 9)] == [
        (RemovalReason.LEASE_EXPIRED, "dormant")
    ]
    falls_under_another_policy(sidecar)
    assert [(one.removal.reason, one.kept) for one in sidecar.engine.removed_peers(0.0, 9)] == [
        (RemovalReason.FORBIDDEN, None)
    ]


ENDS = (has_left, falls_under_another_policy, restarts, is_listed_with_a_later_session, has_lied)


@pytest.mark.parametrize("ends", ENDS, ids=lambda act: act.__name__)
def test_a_request_at_a_dormant_server_ends_when_the_server_cannot_come_back(ends: Callable[[Sidecar], None]) -> None:
    sidecar = asking()
    ends(sidecar)
    assert [event.reason for event in sidecar.take()[1] if isinstance(event, RequestFailed)] == [WENT_AWAY]
    assert sidecar.engine.busy == 0


def test_a_request_at_a_dormant_server_ends_when_too_many_others_are(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("plr.sidecar.core.engine.dormant.MAX_PEERS", 1)
    sidecar = asking()
    sidecar.view(peer(B, session=2), version=3)
    assert [event.reason for event in sidecar.take()[1] if isinstance(event, RequestFailed)] == [WENT_AWAY]


def test_a_listed_server_that_was_dormant_goes_on() -> None:
    sidecar = asking()
    sidecar.view(peer(A), version=3)
    sidecar.change(PathState.UP, 3.0)
    commands, events = sidecar.take()
    assert [type(command) for command in commands].count(Resend) == 1
    assert not [event for event in events if isinstance(event, RequestFailed)]


def silent_cloud() -> Sidecar:
    sidecar = cloud()
    sidecar.view()
    sidecar.change(PathState.DOWN, 0.2)
    assert sidecar.engine.peers.is_dormant(sidecar.path.peer)
    sidecar.take()
    return sidecar


def test_what_a_dormant_robot_sends_before_its_path_is_up_is_taken() -> None:
    """The link has acknowledged it, so the robot does not send it again."""
    sidecar = silent_cloud()
    sidecar.receive(request(1))
    (execution,) = sidecar.take()[1]
    assert isinstance(execution, ExecuteRequest)
    assert sidecar.engine.peers.is_dormant(sidecar.path.peer), "it is not known yet whether datagrams arrive there"
    assert sidecar.engine.busy == 1, "a cloud that drains waits for it"
    sidecar.engine.on_link_event(FinishedLost(sidecar.path, (1,)), 0.3)
    sidecar.engine.cloud.complete(execution.execution, b"answer", 0.1, 0.4)
    (send,) = (command for command in sidecar.take()[0] if isinstance(command, Send))
    sidecar.engine.on_link_event(FragmentsLost(sidecar.path, send.message, (0,)), 0.4)
    assert not sidecar.take()[0]
    sidecar.change(PathState.UP, 0.5)
    assert [type(command) for command in sidecar.take()[0]] == [Resend, SendFinished]


def test_what_came_in_part_before_a_silence_is_completed_after_it() -> None:
    sidecar = cloud()
    data = b"".join(
        encode_message(RequestMessage(request_id(1), 0, Priority.NORMAL, 0.1, 9.0, ECHO, TYPE, bytes(1500)))
    )
    first, second = (Fragment(5, len(data), 1000, index, memoryview(data)[1000 * index :][:1000]) for index in (0, 1))
    sidecar.engine.on_link_event(FragmentsReceived(sidecar.path, SessionId(1), [first]), 0.1)
    sidecar.view(version=2)
    sidecar.change(PathState.DOWN, 0.2)
    sidecar.change(PathState.UP, 3.0)
    sidecar.take()
    sidecar.engine.on_link_event(FragmentsReceived(sidecar.path, SessionId(1), [second]), 3.0)
    assert [type(event) for event in sidecar.take()[1]] == [ExecuteRequest]


def test_a_forgotten_robot_is_not_heard() -> None:
    sidecar = silent_cloud()
    lose(sidecar, reason=RemovalReason.LEFT)
    sidecar.receive(request(1))
    assert not sidecar.take()[1]
    assert sidecar.engine.stats.dropped["fragment_of_old_session"] == 1
    assert not sidecar.engine._inbound._reassemblers
