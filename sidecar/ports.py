"""Defines the seams of the data plane: to the ROS bridge (both directions), and to the control client."""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    from plr.protos.model.ids import ServiceName, SessionId
    from plr.protos.model.mapping import MappingSet
    from plr.protos.model.members import PeerSet, ServiceOffer
    from plr.protos.model.report import Report
    from plr.sidecar.core.base.report_scope import ReportScope
    from plr.sidecar.core.base.values import ExecutionId, RejectReason, RequestId
    from plr.sidecar.core.seam.application import ApplicationEvent, CarriedService


class DataPlane(Protocol):
    """The calls open to the application side, from any thread; none of them blocks."""

    @property
    def session(self) -> SessionId:
        """This run's session."""

    def submit(self, request_id: RequestId, service: ServiceName, payload: bytes) -> None:
        """Robot: send a serialised request; it ends in exactly one RequestFailed, or with an answer judged good."""

    def judge_answer(self, request_id: RequestId, copy: int, problem: str | None) -> None:
        """Robot: report that the application has this copy's answer, or the `problem` that kept it from delivery.

        It must be called for every ResponseArrived. After a problem, another server's answer is taken.
        """

    def answered_locally(self, request_id: RequestId) -> None:
        """Robot: report that the application has an answer from elsewhere; the request's end is told all the same."""

    def complete(self, execution: ExecutionId, payload: bytes, processing_s: float) -> None:
        """Cloud: report that the local server answered after `processing_s` seconds."""

    def refuse(self, execution: ExecutionId, reason: RejectReason, detail: str) -> None:
        """Cloud: report that the request was not or will not be answered."""

    def set_offers(self, offers: tuple[ServiceOffer, ...]) -> None:
        """Cloud: replace the set of services that local servers offer now."""

    def set_carried(self, services: frozenset[CarriedService]) -> None:
        """Robot: replace the set of proxied services that exist in the local ROS graph now."""


class ControlledDataPlane(Protocol):
    """The calls open to the control client, from any thread; they may wait for the engine's lock."""

    def apply_peers(self, peer_set: PeerSet) -> str | None:
        """Put the peers in force; return why they are refused, or None."""

    def apply_mapping(self, mapping: MappingSet) -> str | None:
        """Put the mapping in force; return why it is refused, or None."""

    def take_report(self, scope: ReportScope) -> Report:
        """Return what was measured since the last call."""


class Application(Protocol):
    """The calls that the data plane makes."""

    def handle(self, event: ApplicationEvent) -> None:
        """Take an event. Data-plane threads call this, so it must return at once.

        It may call the data plane to answer a request on the spot: that saves two wake-ups, and the answer leaves
        before the thread that received the request sleeps. Work that takes time (a ROS server) belongs in a queue.
        """
