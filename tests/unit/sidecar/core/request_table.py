"""A request table that a test drives from both sides."""

from __future__ import annotations

from typing import TYPE_CHECKING

from plr.sidecar.core.base.request_id import OBSERVED_ONE_IN
from plr.sidecar.core.base.values import PathId, PathState, Priority, RejectReason, RequestId
from plr.sidecar.core.robot.dispatch.context import RequestParts
from plr.sidecar.core.robot.measure.measurements import Measurements
from plr.sidecar.core.robot.request.mapping_table import MappingTable
from plr.sidecar.core.robot.request.service_catalog import Offers
from plr.sidecar.core.robot.request_table import RequestTable
from plr.sidecar.core.rules.service_rule import Rules, ServiceRule
from plr.sidecar.core.seam.application import ApplicationEvent, RequestFailed, ResponseArrived
from plr.sidecar.core.seam.links import LinkCommand, Send
from plr.sidecar.core.seam.stats import EngineStats
from plr.sidecar.core.transfer.outbox import Outbox
from plr.sidecar.core.transfer.routes import Routes
from plr.sidecar.core.wire.messages import CancelMessage, RejectionMessage, ResponseMessage, decode_message
from tests.support.builders import ECHO, WLAN, WWAN, A, B, path, peer, request_id

if TYPE_CHECKING:
    from plr.sidecar.core.rules.budget import Budget

WLAN_A, WWAN_B = path(WLAN, A), path(WWAN, B)
SERVERS = {A: WLAN_A, B: WWAN_B}
RACE = OBSERVED_ONE_IN
"""Number of a request whose copies are all measured."""


class Table:
    """A request table whose commands and events the test reads; wlan0 reaches cloud-a, wwan0 cloud-b."""

    def __init__(
        self,
        *,
        idempotent: bool = True,
        drop_late: bool = False,
        exploration: float = 0.0,
        budgets: tuple[Budget, ...] = (),
    ) -> None:
        rule = ServiceRule(ECHO, 1.0, 10.0, idempotent=idempotent, drop_late=drop_late, exploration=exploration)
        self.routes, self.stats = Routes(), EngineStats()
        self.measurements = Measurements(self.stats.dropped)
        self.commands: list[LinkCommand] = []
        self.events: list[ApplicationEvent] = []
        self.judges = True
        """Answers are judged good as soon as they come."""
        self._judged = 0
        self.outbox = Outbox(self.routes, self.commands.append, self.stats)
        self.offers = offers = Offers(Rules((rule,)), self.stats)
        self.rule = rule
        for one in (peer(A), peer(B, session=2)):
            offers.set_peer(one)
        self.mapping = MappingTable(self.routes)
        self.parts = RequestParts(
            offers,
            self.mapping,
            self.routes,
            self.outbox,
            self.measurements,
            self.stats,
            self.events.append,
            self.commands.append,
            budgets,
        )
        self.table = RequestTable(self.parts)
        for known in SERVERS.values():
            self.routes.set_state(known, PathState.UP)
        offers.update(self.routes, 0.0)

    @property
    def rule(self) -> ServiceRule:
        """The rule of the requests submitted from now on."""
        return self._rule

    @rule.setter
    def rule(self, rule: ServiceRule) -> None:
        self._rule = rule
        self.offers._rules = Rules((rule,))

    def submit(self, number: int = 1, payload: bytes = b"question", now: float = 0.0, *, begun: bool = True) -> None:
        self.table.submit(request_id(number), ECHO, payload, now)
        for command in self.commands if begun else ():
            if isinstance(command, Send):
                command.message.begun = True

    def handle_timers(self, now: float) -> None:
        """Let time pass, in as many turns as that takes."""
        while (timer := self.table.next_timer()) is not None and timer <= now:
            self.parts.backlog.begin_turn(now)
            self.table.handle_timer(now)

    def sent(self) -> list[PathId]:
        """Paths that got copies since the last look."""
        paths = [command.path for command in self.commands if isinstance(command, Send)]
        self.commands.clear()
        return paths

    def cancelled(self) -> list[tuple[PathId, RequestId]]:
        """What was cancelled where; those messages count as delivered."""
        found = []
        for message in list(self.outbox._messages.values()):
            content = decode_message(memoryview(b"".join(message.symbols.content)))
            if isinstance(content, CancelMessage):
                assert message.symbols.priority is Priority.HIGH
                found.append((message.path, content.request_id))
                self.outbox.drop(message)
        return found

    def latencies(self) -> dict[str, tuple[int, int]]:
        """(answered, not answered: called off or lost) by server."""
        reports = self.measurements.take(self.routes, []).latencies
        return {
            report.server: (
                report.network.answered,
                report.network.lost + report.called_off.total + report.processing.lost,
            )
            for report in reports
        }

    def respond(self, server: str = A, copy: int = 0, number: int = 1, now: float = 0.1, size: int = 0) -> None:
        response = ResponseMessage(request_id(number), copy, 0.01, (b"from " + server.encode()).ljust(size))
        self.table.on_response(peer(server).name, response, now)
        if self.judges:
            self.judge(now)

    def judge(self, now: float, problem: str | None = None) -> None:
        """Say of all answers that were not judged yet that they are delivered, or why not."""
        arrived = [event for event in self.events if isinstance(event, ResponseArrived)]
        while self._judged < len(arrived):
            event = arrived[self._judged]
            self._judged += 1
            self.table.judge_answer(event.request_id, event.copy, problem, now)

    def reject(self, reason: RejectReason, server: str = A, copy: int = 0, now: float = 0.1, number: int = 1) -> None:
        self.table.on_rejection(peer(server).name, RejectionMessage(request_id(number), copy, reason, "why"), now)

    def change(self, changed: PathId, state: PathState, now: float = 0.1) -> None:
        self.routes.set_state(changed, state)
        self.table.on_path_changed(changed, state, now)
        self.finish(now)

    def use_room(self, now: float) -> None:
        self.table.on_room(now)
        self.finish(now)

    def finish(self, now: float) -> None:
        """Let the table do what it had no time for in one turn."""
        while len(self.parts.backlog):
            self.parts.backlog.begin_turn(now)
            self.parts.backlog.run(now)

    def only_failure(self) -> RequestFailed:
        (failed,) = [event for event in self.events if isinstance(event, RequestFailed)]
        return failed

    def assert_empty(self) -> None:
        assert self.table.unanswered == 0
        assert not self.table._requests
        assert len(self.outbox) == 0
        assert self.table.next_timer() is None
