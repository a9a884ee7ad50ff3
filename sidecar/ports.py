"""The seams between the sidecar's parts: what the ROS bridge asks of the data plane, and the other way round."""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    from collections.abc import Mapping

    from protos.model.ids import ServiceName, SessionId
    from protos.model.members import ServiceOffer
    from sidecar.core.base.values import ExecutionId, RejectReason, RequestId
    from sidecar.core.seam.application import ApplicationEvent


class DataPlane(Protocol):
    """What the application side may call, from any thread; nothing here blocks."""

    @property
    def session(self) -> SessionId:
        """This run's session."""

    def submit(self, request_id: RequestId, service: ServiceName, payload: bytes) -> None:
        """Robot: send a serialised request. It ends in exactly one RequestFailed, or with an answer judged good."""

    def judge_answer(self, request_id: RequestId, copy: int, problem: str | None) -> None:
        """Robot: this copy's answer is with the application, or can not be delivered, for this reason.

        To be said of every ResponseArrived. After a problem another server's answer is taken.
        """

    def answered_here(self, request_id: RequestId) -> None:
        """Robot: the application has its answer, not from the network; how the request ends is told all the same."""

    def complete(self, execution: ExecutionId, payload: bytes, processing_s: float) -> None:
        """Cloud: the local server answered after `processing_s` seconds."""

    def refuse(self, execution: ExecutionId, reason: RejectReason, detail: str) -> None:
        """Cloud: the request was not or will not be answered."""

    def set_offers(self, offers: tuple[ServiceOffer, ...]) -> None:
        """Cloud: the services that local servers offer right now, a whole new set."""

    def set_carried(self, services: Mapping[ServiceName, bool | None]) -> None:
        """Robot: the proxied services that exist in the local ROS graph right now, a whole new set.

        Of each, whether its fallback can be asked; None where it has none.
        """


class Application(Protocol):
    """What the data plane calls."""

    def handle(self, event: ApplicationEvent) -> None:
        """Take an event. Called from data-plane threads: must return at once.

        It may call the data plane, to answer a request then and there: that saves two wake-ups, and its answer leaves
        before the thread that received the request sleeps. What takes time (a ROS server) belongs into a queue.
        """
