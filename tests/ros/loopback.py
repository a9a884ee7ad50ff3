"""A data plane without a network: joins a robot bridge and a cloud bridge in this process, with faults."""

from __future__ import annotations

import heapq
import itertools
import logging
import threading
import time
from collections import Counter
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from plr.protos.model.ids import InterfaceName, NodeName, ServiceName, SessionId
from plr.protos.model.mapping import Assignment
from plr.sidecar.core.base.values import ExecutionId, Priority
from plr.sidecar.core.seam.application import (
    AbandonExecution,
    DeadlineMissed,
    ExecuteRequest,
    OfferService,
    RequestFailed,
    ResponseArrived,
    WithdrawService,
)

if TYPE_CHECKING:
    from collections.abc import Callable

    from plr.protos.model.members import ServiceOffer
    from plr.sidecar.core.base.values import RejectReason, RequestId
    from plr.sidecar.core.seam.application import CarriedService
    from plr.sidecar.ports import Application

log = logging.getLogger(__name__)

SERVER = NodeName("cloud")
ROBOT = NodeName("robot")
INTERFACE = InterfaceName("lo-test")


@dataclass
class Faults:
    """What the loopback does to traffic; may be changed while it runs."""

    delay_s: Callable[[], float] = field(default=lambda: 0.0)
    """One-way delay of each request and each response."""
    duplicate_responses: bool = False
    """Hand over each response twice, which a data plane must not do: the bridge has to stand it."""
    drop_requests: bool = False
    deadline_s: float = 60.0
    lifetime_s: float = 60.0
    mangle_request: Callable[[bytes], bytes] = field(default=lambda payload: payload)
    mangle_response: Callable[[bytes], bytes] = field(default=lambda payload: payload)


@dataclass
class _Request:
    id: RequestId
    service: ServiceName
    submitted_at: float
    answered: bool = False


class Loopback:
    """Both data planes and the wire between them."""

    def __init__(self, robot: Application, cloud: Application, faults: Faults | None = None) -> None:
        self.robot_app = robot
        self.cloud_app = cloud
        self.faults = faults or Faults()
        self.robot = RobotPlane(self)
        self.cloud = CloudPlane(self)
        self.offers: tuple[ServiceOffer, ...] = ()
        self.carried: frozenset[ServiceName] = frozenset()
        self.refusals: list[tuple[RejectReason, str]] = []
        self.answered_locally: list[RequestId] = []
        self.asker = ROBOT
        """Whose requests the cloud is told these are."""
        self.counts: Counter[str] = Counter()
        self.processing_s: list[float] = []
        self.requests: dict[RequestId, _Request] = {}
        self.executions: dict[ExecutionId, RequestId] = {}
        self._numbers = itertools.count(1)
        self._timers: list[tuple[float, int, Callable[[], None]]] = []
        self._changed = threading.Condition()
        self._stopping = False
        self._thread = threading.Thread(target=self._run, name="loopback", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        with self._changed:
            self._stopping = True
            self._changed.notify()
        self._thread.join(5.0)
        assert not self._thread.is_alive()

    def after(self, delay_s: float, action: Callable[[], None]) -> None:
        with self._changed:
            heapq.heappush(self._timers, (time.monotonic() + delay_s, next(self._numbers), action))
            self._changed.notify()

    def _run(self) -> None:
        while True:
            with self._changed:
                while not self._stopping:
                    now = time.monotonic()
                    if self._timers and self._timers[0][0] <= now:
                        break
                    self._changed.wait(self._timers[0][0] - now if self._timers else None)
                if self._stopping:
                    return
                action = heapq.heappop(self._timers)[2]
            action()

    # -- what the bridges cause --------------------------------------------------------------------------------------

    def submitted(self, request_id: RequestId, service: ServiceName, payload: bytes) -> None:
        assert request_id not in self.requests, "a request id came twice"
        request = _Request(request_id, service, time.monotonic())
        self.requests[request_id] = request
        self.counts["submitted"] += 1
        if self.faults.deadline_s < 60.0:
            self.after(self.faults.deadline_s, lambda: self._deadline(request))
        self.after(self.faults.lifetime_s, lambda: self._give_up(request))
        if self.faults.drop_requests:
            return
        payload = self.faults.mangle_request(payload)
        self.after(self.faults.delay_s(), lambda: self._execute(request, payload))

    def _execute(self, request: _Request, payload: bytes) -> None:
        execution = ExecutionId(next(self._numbers))
        self.executions[execution] = request.id
        kind = next((offer.type for offer in self.offers if offer.name == request.service), "none/srv/None")
        self.cloud_app.handle(
            ExecuteRequest(
                execution,
                request.service,
                kind,
                payload,
                self.asker,
                Priority.NORMAL,
                self.faults.deadline_s,
                self.faults.lifetime_s,
            )
        )

    def completed(self, execution: ExecutionId, payload: bytes, processing_s: float) -> None:
        self.counts["completed"] += 1
        self.processing_s.append(processing_s)
        request = self.requests[self.executions.pop(execution)]
        payload = self.faults.mangle_response(payload)
        self.after(self.faults.delay_s(), lambda: self._respond(request, payload))

    def _respond(self, request: _Request, payload: bytes) -> None:
        request.answered = True
        elapsed = time.monotonic() - request.submitted_at
        event = ResponseArrived(
            request.id, request.service, 0, payload, SERVER, INTERFACE, elapsed, elapsed > self.faults.deadline_s
        )
        self.robot_app.handle(event)
        if self.faults.duplicate_responses:
            self.robot_app.handle(event)

    def judged(self, request_id: RequestId, problem: str | None) -> None:
        """There is no other server that could be asked."""
        if problem is not None:
            request = self.requests[request_id]
            self.robot_app.handle(RequestFailed(request.id, request.service, "failed", problem, 0.0))

    def refused(self, execution: ExecutionId, reason: RejectReason, detail: str) -> None:
        self.refusals.append((reason, detail))
        request = self.requests[self.executions.pop(execution)]
        request.answered = True
        elapsed = time.monotonic() - request.submitted_at
        self.robot_app.handle(
            RequestFailed(request.id, request.service, "rejected", f"{reason.name}: {detail}", elapsed)
        )

    def _deadline(self, request: _Request) -> None:
        if not request.answered:
            self.robot_app.handle(
                DeadlineMissed(request.id, request.service, self.faults.deadline_s, (Assignment(INTERFACE, SERVER),))
            )

    def _give_up(self, request: _Request) -> None:
        if request.answered:
            return
        request.answered = True
        for execution in [e for e, request_id in self.executions.items() if request_id == request.id]:
            self.cloud_app.handle(AbandonExecution(execution, self.asker))
        self.robot_app.handle(
            RequestFailed(request.id, request.service, "failed", "lifetime over", self.faults.lifetime_s)
        )

    def offered(self, offers: tuple[ServiceOffer, ...]) -> None:
        old = {offer.name: offer.type for offer in self.offers}
        new = {offer.name: offer.type for offer in offers}
        self.offers = offers
        for name in old.keys() - new.keys():
            self.robot_app.handle(WithdrawService(name, "no server left"))
        for name, kind in new.items():
            if old.get(name) != kind:
                self.robot_app.handle(OfferService(name, kind))


class RobotPlane:
    """What the robot's bridge sees."""

    def __init__(self, link: Loopback) -> None:
        self._link = link
        self.session = SessionId(0x1122334455667788)

    def submit(self, request_id: RequestId, service: ServiceName, payload: bytes) -> None:
        self._link.submitted(request_id, service, payload)

    def judge_answer(self, request_id: RequestId, copy: int, problem: str | None) -> None:
        self._link.judged(request_id, problem)

    def answered_locally(self, request_id: RequestId) -> None:
        self._link.answered_locally.append(request_id)

    def complete(self, execution: ExecutionId, payload: bytes, processing_s: float) -> None:
        raise AssertionError("a robot completes nothing")

    def refuse(self, execution: ExecutionId, reason: RejectReason, detail: str) -> None:
        raise AssertionError("a robot refuses nothing")

    def set_offers(self, offers: tuple[ServiceOffer, ...]) -> None:
        raise AssertionError("a robot offers nothing")

    def set_carried(self, services: frozenset[CarriedService]) -> None:
        self._link.carried = frozenset(service.name for service in services)


class CloudPlane:
    """What the cloud's bridge sees."""

    def __init__(self, link: Loopback) -> None:
        self._link = link
        self.session = SessionId(0x99AABBCCDDEEFF00)

    def submit(self, request_id: RequestId, service: ServiceName, payload: bytes) -> None:
        raise AssertionError("a server submits nothing")

    def judge_answer(self, request_id: RequestId, copy: int, problem: str | None) -> None:
        raise AssertionError("a server asks nothing")

    def answered_locally(self, request_id: RequestId) -> None:
        raise AssertionError("a server asks nothing")

    def complete(self, execution: ExecutionId, payload: bytes, processing_s: float) -> None:
        self._link.completed(execution, payload, processing_s)

    def refuse(self, execution: ExecutionId, reason: RejectReason, detail: str) -> None:
        self._link.refused(execution, reason, detail)

    def set_offers(self, offers: tuple[ServiceOffer, ...]) -> None:
        self._link.offered(offers)

    def set_carried(self, services: frozenset[CarriedService]) -> None:
        raise AssertionError("a server carries nothing")
