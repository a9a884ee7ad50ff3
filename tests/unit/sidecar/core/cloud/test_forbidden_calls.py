from __future__ import annotations

from typing import TYPE_CHECKING

from plr.protos.model.ids import NodeName, ServiceName, SessionId
from plr.protos.model.members import Peer, ServiceOffer
from plr.sidecar.core.base.slices import Backlog
from plr.sidecar.core.base.values import PathState, RejectReason
from plr.sidecar.core.cloud.cloud_role import CloudRole
from plr.sidecar.core.cloud.forbidden_calls import MAX_FORBIDDEN_ROBOTS, TELL_EVERY_S, ForbiddenCalls
from plr.sidecar.core.rules.service_rule import Rules
from plr.sidecar.core.seam.application import ApplicationEvent, CallsForbidden, ExecuteRequest
from plr.sidecar.core.seam.links import PathCommand, Send
from plr.sidecar.core.seam.stats import EngineStats
from plr.sidecar.core.transfer.engine_parts import EngineParts
from plr.sidecar.core.transfer.outbox import Outbox
from plr.sidecar.core.transfer.routes import Routes
from plr.sidecar.core.wire.messages import RejectionMessage, ResponseMessage, decode_message
from tests.support.builders import ECHO, TYPE, WLAN, path, peer, request, rule

if TYPE_CHECKING:
    from plr.sidecar.core.wire.messages import Message

ROBOT, OTHER = NodeName("robot"), NodeName("robot-2")
SECRET = ServiceName("/secret")


class Robots:
    """The peers: robots that may call what stands in `permits`."""

    def __init__(self, *permits: tuple[NodeName, ServiceName]) -> None:
        self.permits = set(permits)

    def __contains__(self, name: object) -> bool:
        return name in self.names()

    def names(self) -> list[NodeName]:
        return [ROBOT, OTHER]

    def get(self, name: NodeName) -> Peer | None:
        return peer(name)

    def session(self, name: NodeName) -> SessionId | None:
        return SessionId(1) if name in self.names() else None

    def is_dormant(self, name: NodeName) -> bool:
        return name not in self.names()

    def may_call(self, name: NodeName, service: ServiceName) -> bool:
        return (name, service) in self.permits


class Cloud:
    """The role of a cloud that offers /echo and /secret, and lets robots call what stands in `permits`."""

    def __init__(self) -> None:
        self.robots = Robots((ROBOT, ECHO))
        self.events: list[ApplicationEvent] = []
        self.commands: list[PathCommand] = []
        self.stats = EngineStats()
        routes = Routes()
        routes.set_state(path(WLAN, ROBOT), PathState.UP)
        routes.set_state(path(WLAN, OTHER), PathState.UP)
        outbox = Outbox(routes, self.commands.append, self.stats)
        self.role = CloudRole(
            EngineParts(
                Rules((rule("/*"),)),
                self.robots,
                routes,
                outbox,
                self.stats,
                self.events.append,
                lambda _command: None,
                Backlog(),
            )
        )
        self.role.set_offers([ServiceOffer(ECHO, TYPE), ServiceOffer(SECRET, TYPE)])

    def ask(self, number: int, service: ServiceName, *, robot: NodeName = ROBOT, now: float = 1.0) -> list[Message]:
        """One request; returns what is sent back."""
        self.role.on_message(path(WLAN, robot), request(number, service=service), now + 10.0, now)
        return self.sent()

    def sent(self) -> list[Message]:
        sends = [command for command in self.commands if isinstance(command, Send)]
        self.commands.clear()
        return [decode_message(memoryview(b"".join(send.message.content))) for send in sends]


def test_a_call_that_is_not_permitted_is_refused_with_its_reason_and_reaches_nobody() -> None:
    cloud = Cloud()
    (reply,) = cloud.ask(1, SECRET)
    assert isinstance(reply, RejectionMessage)
    assert reply.reason is RejectReason.FORBIDDEN
    assert reply.reason.certainly_not_run
    assert str(SECRET) in reply.text
    assert cloud.events == [CallsForbidden(ROBOT, SECRET, 1)]
    assert cloud.stats.dropped["request_forbidden"] == 1
    assert cloud.role.executions.running == 0


def test_it_is_not_told_whether_the_service_is_offered_or_the_cloud_drains() -> None:
    cloud = Cloud()
    cloud.role.drain()
    answers = [cloud.ask(number, name) for number, name in enumerate((SECRET, ServiceName("/nothing")))]
    assert [reply.reason for (reply,) in answers if isinstance(reply, RejectionMessage)] == [RejectReason.FORBIDDEN] * 2


def test_names_that_robots_write_make_no_counters() -> None:
    cloud = Cloud()
    for number in range(100):
        cloud.ask(number, ServiceName(f"/made_up_{number}"))
    assert cloud.stats.executions == {}
    assert cloud.stats.dropped == {"request_forbidden": 100}


def test_what_is_permitted_runs_beside_it() -> None:
    cloud = Cloud()
    cloud.ask(1, SECRET)
    assert cloud.ask(2, ECHO) == []
    assert [event.service for event in cloud.events if isinstance(event, ExecuteRequest)] == [ECHO]


def test_a_permit_of_one_robot_is_none_of_another() -> None:
    cloud = Cloud()
    (reply,) = cloud.ask(1, ECHO, robot=OTHER)
    assert isinstance(reply, RejectionMessage)
    assert reply.reason is RejectReason.FORBIDDEN


def test_a_request_that_runs_when_its_permit_goes_is_answered_to_all_its_copies() -> None:
    cloud = Cloud()
    cloud.ask(1, ECHO)
    (execution,) = (event for event in cloud.events if isinstance(event, ExecuteRequest))
    cloud.robots.permits.clear()
    cloud.role.on_message(path(WLAN, ROBOT), request(1, copy=1), 10.0, 1.1)
    cloud.role.complete(execution.execution, b"answer", 0.1, 1.2)
    replies = cloud.sent()
    assert [reply.copy for reply in replies if isinstance(reply, ResponseMessage)] == [0, 1]
    (reply,) = cloud.ask(2, ECHO)
    assert isinstance(reply, RejectionMessage)


def test_the_id_of_a_permitted_request_opens_no_other_service() -> None:
    cloud = Cloud()
    cloud.ask(1, ECHO)
    assert cloud.ask(1, SECRET) == []
    assert cloud.stats.dropped["request_id_mismatch"] == 1
    assert len([event for event in cloud.events if isinstance(event, ExecuteRequest)]) == 1


def test_notices_are_rare_and_count_what_was_not_told() -> None:
    forbidden = ForbiddenCalls()
    told = [forbidden.note(ROBOT, SECRET, 100 + 0.01 * tick) for tick in range(int(TELL_EVERY_S / 0.01) + 1)]
    assert [notice.count for notice in told if notice] == [1, int(TELL_EVERY_S / 0.01)]
    assert forbidden.note(OTHER, ECHO, 101.0) == CallsForbidden(OTHER, ECHO, 1)


def test_the_robots_noted_are_bounded() -> None:
    forbidden = ForbiddenCalls()
    for number in range(2 * MAX_FORBIDDEN_ROBOTS):
        forbidden.note(NodeName(f"r{number}"), ECHO, 1.0)
    assert len(forbidden._robots) == MAX_FORBIDDEN_ROBOTS
