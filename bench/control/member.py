"""Models one sidecar as its control stream shows it: what it sends, what it receives, and when."""

from __future__ import annotations

import hashlib
import time
from typing import TYPE_CHECKING

from plr.protos.base.histogram import Histogram
from plr.protos.model.ids import PROTOCOL_VERSION, InterfaceId, InterfaceName, NodeName, Role, ServiceName
from plr.protos.model.members import (
    Candidate,
    CandidateKind,
    CandidateSet,
    Registration,
    ServiceOffer,
    ServiceSet,
    ServiceUse,
)
from plr.protos.model.report import LatencyReport, OutcomeReport, PathReport, Report
from plr.protos.trust.candidate_signature import sign_candidates
from plr.protos.trust.credential import Aead, SessionCredential, session_number
from plr.sidecar.core.control.session import ControlSession

if TYPE_CHECKING:
    import random

    from plr.controlplane.ca.certificates import Issued
    from plr.protos.model.ids import SessionId
    from plr.protos.model.mapping import Assignment

SERVICE = ServiceName("/plan_path")
TYPE = "bench/srv/Plan"
DEADLINE_S = 0.25
INTERFACES = (InterfaceName("wlan0"), InterfaceName("wwan0"))
PROCESSING_S = 0.02


class Member:
    """A sidecar of the crowd; `servers` are the clouds that robots reach."""

    def __init__(
        self,
        name: NodeName,
        role: Role,
        issued: Issued,
        servers: tuple[NodeName, ...],
        rng: random.Random,
        *,
        interfaces: tuple[InterfaceName, ...] = INTERFACES,
    ) -> None:
        self.name = name
        self.role = role
        self.issued = issued
        self.mapped: frozenset[NodeName] = frozenset()
        """Servers of the mapping in force."""
        self.mapped_at = 0.0
        self.dead: NodeName | None = None
        """The server to which no path is up any more."""
        self.hung: NodeName | None = None
        """The server that accepts requests and answers none."""
        self._servers = servers
        self._interfaces = interfaces
        self._rng = rng
        incarnation = int(time.time() * 1000.0)
        public_key = hashlib.sha256(f"{name} {incarnation}".encode()).digest()
        number = session_number(name, role, public_key)
        credential = SessionCredential(
            name, role, number, incarnation, public_key, Aead.AES_256_GCM, issued.certificate_der
        ).sign(issued.key)
        registration = Registration(
            protocol_version=PROTOCOL_VERSION,
            name=name,
            role=role,
            session=number,
            token=hashlib.sha256(name.encode()).digest()[:16],
            incarnation=incarnation,
            software_version="bench",
            credential=credential.encode(),
        )
        self.session = ControlSession(registration, rng)
        self._announce(number)

    def _announce(self, number: SessionId) -> None:
        interfaces = self._interfaces if self.role is Role.ROBOT else (InterfaceName("eth0"),)
        candidates = tuple(
            Candidate(InterfaceId(place), name, CandidateKind.HOST, (f"10.{place}.0.1", 4000 + place))
            for place, name in enumerate(interfaces)
        )
        signature = sign_candidates(self.issued.key, number, 1, candidates)
        self.session.set_candidates(CandidateSet(candidates, (), 1, signature))
        if self.role is Role.ROBOT:
            self.session.set_services(ServiceSet(uses=(ServiceUse(SERVICE, TYPE, DEADLINE_S, True),)))
        else:
            self.serve(up=True)

    def report(self, interval_s: float) -> Report:
        """Return what a robot measured in this time: ten requests a second over each of its paths in use."""
        if self.role is Role.CLOUD:
            return Report()
        requests = max(round(10 * interval_s), 1)
        paths, latencies = [], []
        for interface in self._interfaces:
            for server in self._servers:
                up = server != self.dead
                rtt = Histogram()
                if up:
                    rtt.record_many([self._rng.lognormvariate(-3.0, 0.4) for _ in range(max(round(interval_s), 1))])
                paths.append(PathReport(interface, server, up, rtt, 10 * requests, 0))
                if up and server in self.mapped:
                    network, processing = Histogram(), Histogram()
                    missed = requests if server == self.hung else 0
                    processing.record_lost(missed)
                    network.record_many([self._rng.lognormvariate(-3.0, 0.4) for _ in range(requests - missed)])
                    processing.record_many([PROCESSING_S] * (requests - missed))
                    latencies.append(
                        LatencyReport(interface, server, SERVICE, 1, network, Histogram(), processing, requests, missed)
                    )
        return Report(tuple(latencies), tuple(paths), (OutcomeReport(SERVICE, ok=requests),))

    def path_changes(self) -> Report:
        """Return what a robot reports at once when a server is dead."""
        paths = [PathReport(interface, self.dead, False, Histogram()) for interface in self._interfaces if self.dead]
        return Report(paths=tuple(paths), changes_only=True)

    def serve(self, *, up: bool) -> None:
        """Note whether the ROS node that serves a cloud's configured service is present."""
        offers = (ServiceOffer(SERVICE, TYPE),) if up else ()
        self.session.set_services(ServiceSet(offers, unmet=() if up else (SERVICE,)))

    def takes(self, assignments: tuple[Assignment, ...], now: float) -> None:
        """Put a mapping into force."""
        self.mapped = frozenset(one.server for one in assignments)
        self.mapped_at = now
