"""Corrupts the control stream of a compromised member: false reports, addresses of others, escape sequences.

Its lies go out on the same stream as the honest sidecar's messages, with the same certificate.
"""

from __future__ import annotations

import random
import time
from dataclasses import replace
from typing import TYPE_CHECKING

from lab.attacker.hostile_link import ESCAPES
from lab.attacker.orders import Stage
from plr.protos.base.histogram import MAX_COUNT, Histogram
from plr.protos.model.ids import InterfaceId, InterfaceName, NodeName, Role, ServiceName, Version
from plr.protos.model.members import (
    MAX_CANDIDATES_OF_INTERFACE,
    Candidate,
    CandidateKind,
    CandidateSet,
    ServiceOffer,
    ServiceSet,
    ServiceUse,
)
from plr.protos.model.report import LatencyReport, OutcomeReport, PathReport, Report
from plr.protos.model.stream import Heartbeat, Nack, ResourceKind
from plr.protos.trust.candidate_signature import sign_candidates
from plr.sidecar.core.control.session import ControlSession, ControlState

if TYPE_CHECKING:
    from lab.attacker.hostile_means import Means
    from plr.protos.model.stream import SidecarMessage

REPORTS_A_TURN = 10
INTERFACES = 32
"""Interfaces with 8 addresses each: as many as one announcement holds."""
CANDIDATES_EVERY_S = 3.0
ESCAPES_EVERY_S = 7.0
"""Interval between escape sequences; some of them end the stream, which then restarts."""
SERVICE_OF_OTHERS = ServiceName("/of_others")
SLOW = Histogram.from_sparse([341], [MAX_COUNT], 0)
FAST = Histogram.from_sparse([10], [MAX_COUNT], 0)


class HostileControl(ControlSession):
    """A control session that sends more than it should."""

    means: Means
    """Set on the class before any instance exists."""
    _candidates_at = 0.0
    _escapes_at = 0.0
    _serial = 1 << 40
    _said = ServiceSet()
    _own = CandidateSet()
    _rng = random.Random(1)

    def messages_to_send(self, now: float) -> list[SidecarMessage]:
        """Return the honest messages and the false ones."""
        honest = super().messages_to_send(now)
        if self.state is not ControlState.ONLINE or self.means.commander.stage is Stage.HONEST:
            return honest
        return [*honest, *self._false(time.monotonic())]

    def _false(self, now: float) -> list[SidecarMessage]:
        false: list[SidecarMessage] = []
        if self._does("false reports", REPORTS_A_TURN):
            false += self._reports()
        if self._does("heartbeats", REPORTS_A_TURN):
            false += [Heartbeat()] * REPORTS_A_TURN
        if self._does("escape sequences in refusals"):
            false.append(Nack(ResourceKind.PEERS, Version(0), self._rng.getrandbits(32), ESCAPES))
        every = INTERFACES * MAX_CANDIDATES_OF_INTERFACE
        if now >= self._candidates_at and self._does("256 addresses of a third party", every):
            self._candidates_at = now + CANDIDATES_EVERY_S
            false.append(self._candidates_of_others())
        if now >= self._escapes_at and self._does("services that are not its own, with escape sequences"):
            self._escapes_at = now + ESCAPES_EVERY_S
            false.append(self._false_services())
        return false

    def _does(self, attack: str, messages: int = 1) -> bool:
        wanted = self.means.commander.want(attack)
        if wanted:
            self.means.tally.add(attack, messages)
        return wanted

    def _reports(self) -> list[SidecarMessage]:
        names = [NodeName(name) for name in self.means.names]
        interface = InterfaceName("eth0")
        service = ServiceName(self.means.service[0])
        latencies = tuple(
            LatencyReport(
                interface,
                name,
                what,
                self._rng.randrange(3),
                SLOW,
                Histogram(),
                SLOW if number % 2 else FAST,
                1000,
                1000,
            )
            for number, name in enumerate(names)
            for what in (service, SERVICE_OF_OTHERS)
        )
        paths = tuple(PathReport(interface, name, False, SLOW) for name in names)
        outcomes = (OutcomeReport(SERVICE_OF_OTHERS, 0, 0, 1000),)
        return [Report(latencies, paths, outcomes)] * REPORTS_A_TURN

    def _candidates_of_others(self) -> CandidateSet:
        """Return its own previous candidates, and as many of the third party's as fit, correctly signed."""
        own = self._own.candidates
        false = tuple(
            Candidate(
                InterfaceId(100 + number // MAX_CANDIDATES_OF_INTERFACE),
                InterfaceName(f"p{number // MAX_CANDIDATES_OF_INTERFACE}"),
                CandidateKind.HOST,
                (self.means.third_party[number % 2], 1000 + number),
            )
            for number in range(INTERFACES * MAX_CANDIDATES_OF_INTERFACE - len(own))
        )
        self._candidates = self._signed((*own, *false))
        return self._candidates

    def _signed(self, said: tuple[Candidate, ...]) -> CandidateSet:
        self._serial += 1
        signature = sign_candidates(self.means.key, self._registration.session, self._serial, said)
        return replace(self._own, candidates=said, serial=self._serial, signature=signature)

    def set_candidates(self, candidates: CandidateSet) -> None:
        """Keep the honest candidates; false ones stay until the next lie."""
        self._own = candidates
        super().set_candidates(self._signed(candidates.candidates))

    def _false_services(self) -> ServiceSet:
        offers = (ServiceOffer(SERVICE_OF_OTHERS, "x/srv/" + ESCAPES), *self._said.offers)
        uses = (ServiceUse(SERVICE_OF_OTHERS, "x/srv/" + ESCAPES, 1e-3, True), *self._said.uses)
        return ServiceSet(offers if self._registration.role is Role.CLOUD else (), uses)

    def set_services(self, services: ServiceSet) -> None:
        """Keep the honest services."""
        self._said = services
        super().set_services(services)
