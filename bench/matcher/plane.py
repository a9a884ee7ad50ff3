"""Runs the control plane's core with one robot and its servers, in simulated time."""

from __future__ import annotations

import zlib
from typing import TYPE_CHECKING

from bench.matcher.feed import REPORT_INTERVAL_S, ROBOT, SERVICE
from plr.controlplane.core.control.control import ControlCore
from plr.controlplane.core.control.events import Settings
from plr.controlplane.core.publish.messages import SendMessage
from plr.controlplane.core.registry.registry import Refusal
from plr.controlplane.solver.matcher import Matcher
from plr.protos.model.ids import PROTOCOL_VERSION, InterfaceId, InterfaceName, Role, SessionId
from plr.protos.model.mapping import MappingSet, ServiceMapping
from plr.protos.model.members import (
    Candidate,
    CandidateKind,
    CandidateSet,
    Registration,
    ServiceOffer,
    ServiceSet,
    ServiceUse,
)

if TYPE_CHECKING:
    from collections.abc import Sequence

    from plr.controlplane.core.registry.registry import StreamId
    from plr.protos.model.ids import NodeName
    from plr.protos.model.mapping import Assignment
    from plr.protos.model.stream import SidecarMessage

FOREVER_S = 1e9
JOINED_S = -2.0
"""When all have registered, before the first request."""
SOLVER_LIMIT_S = 1.0
TYPE = "bench/srv/Detect"


class Plane:
    """A control plane with one robot and its servers."""

    def __init__(self, pairs: Sequence[Assignment], deadline_s: float) -> None:
        settings = Settings(lease_s=FOREVER_S, warm_up_s=0.0, report_interval_s=REPORT_INTERVAL_S)
        self._core = ControlCore(settings, version_epoch=1, now=JOINED_S)
        self._matcher = Matcher()
        for server in dict.fromkeys(pair.server for pair in pairs):
            self._join(server, Role.CLOUD, (InterfaceName("eth0"),), ServiceSet(offers=(ServiceOffer(SERVICE, TYPE),)))
        interfaces = tuple(dict.fromkeys(pair.interface for pair in pairs))
        services = ServiceSet(uses=(ServiceUse(SERVICE, TYPE, deadline_s, True),))
        self._robot = self._join(ROBOT, Role.ROBOT, interfaces, services)
        self.mapping: ServiceMapping | None = None
        self._advance(JOINED_S / 2)

    def _join(
        self, name: NodeName, role: Role, interfaces: tuple[InterfaceName, ...], services: ServiceSet
    ) -> StreamId:
        session = SessionId(zlib.crc32(name.encode()))
        stream = self._core.register(
            Registration(PROTOCOL_VERSION, name, role, session, name.encode().ljust(16, b"*"), 1, "bench"), JOINED_S
        )
        if isinstance(stream, Refusal):
            raise TypeError(stream)
        candidates = tuple(
            Candidate(InterfaceId(number), interface, CandidateKind.HOST, ("10.0.0.1", 4000 + number))
            for number, interface in enumerate(interfaces)
        )
        self._core.receive(stream, CandidateSet(candidates), JOINED_S)
        self._core.receive(stream, services, JOINED_S)
        return stream

    def take(self, message: SidecarMessage, now: float) -> None:
        """Take a message of the robot; the mapping that follows is in force at once."""
        self._core.receive(self._robot, message, now)
        self._advance(now)

    def _advance(self, now: float) -> None:
        self._core.handle_timer(now)
        picture = self._core.start_solving(now)
        if picture is not None:
            plan = self._matcher.solve(picture.problem, time_limit_s=SOLVER_LIMIT_S, hint=self._core.plan)
            self._core.solved(self._core.settle(picture, plan, now), now)
        while (event := self._core.next_event()) is not None:
            if isinstance(event, SendMessage) and event.stream == self._robot and isinstance(event.message, MappingSet):
                self.mapping = next(iter(event.message.services), None)
