"""Small valid values of the model for the tests of the control plane."""

from __future__ import annotations

import zlib

from plr.controlplane.core.registry.registry import StreamId
from plr.protos.base.histogram import Histogram
from plr.protos.model.ids import (
    PROTOCOL_VERSION,
    InterfaceId,
    InterfaceName,
    NodeName,
    Role,
    ServiceName,
    SessionId,
    Version,
)
from plr.protos.model.members import (
    EVERY_INTERFACE,
    Candidate,
    CandidateKind,
    Copies,
    Registration,
    ServiceOffer,
    ServiceUse,
)
from plr.protos.model.redundancy_mode import RedundancyMode
from plr.protos.model.report import LatencyReport, PathReport

PLAN = ServiceName("/plan")
PLAN_TYPE = "nav_msgs/srv/GetPlan"


def registration(
    name: str,
    role: Role = Role.ROBOT,
    *,
    incarnation: int = 1,
    token: bytes | None = None,
    session: int | None = None,
    held: int = 0,
) -> Registration:
    return Registration(
        protocol_version=PROTOCOL_VERSION,
        name=NodeName(name),
        role=role,
        session=SessionId(session if session is not None else zlib.crc32(name.encode()) + incarnation),
        token=token if token is not None else name.encode().ljust(16, b"*")[:16],
        incarnation=incarnation,
        software_version="test",
        peers_version=Version(held),
        mapping_version=Version(held),
    )


def candidate(interface: str, number: int = 0, ip: str = "10.0.0.1", port: int = 4000) -> Candidate:
    return Candidate(InterfaceId(number), InterfaceName(interface), CandidateKind.HOST, (ip, port))


def interfaces(*names: str) -> tuple[Candidate, ...]:
    return tuple(candidate(name, number) for number, name in enumerate(names))


def use(
    name: str = PLAN,
    *,
    deadline_s: float = 0.1,
    idempotent: bool = True,
    type_: str = PLAN_TYPE,
    copies: Copies = EVERY_INTERFACE,
    target_miss: float = 0.0,
    redundancy: RedundancyMode = RedundancyMode.REPLICATE,
) -> ServiceUse:
    return ServiceUse(ServiceName(name), type_, deadline_s, idempotent, copies, target_miss, redundancy=redundancy)


def offer(name: str = PLAN, *, capacity: int = 0, type_: str = PLAN_TYPE) -> ServiceOffer:
    return ServiceOffer(ServiceName(name), type_, capacity)


def histogram(*seconds: float, times: int = 1, lost: int = 0) -> Histogram:
    made = Histogram()
    for _ in range(times):
        for value in seconds:
            made.record(value)
    made.record_lost(lost)
    return made


def path(interface: str, server: str, *, up: bool = True, rtt: Histogram | None = None) -> PathReport:
    return PathReport(InterfaceName(interface), NodeName(server), up, rtt if rtt is not None else Histogram())


def latency(
    interface: str,
    server: str,
    measured: Histogram,
    *,
    processing: Histogram | None = None,
    service: str = PLAN,
    size_class: int = 0,
    deadline_s: float = 0.1,
) -> LatencyReport:
    """Of requests whose outcome by the deadline became known with what the network took; processing matters little."""
    return LatencyReport(
        InterfaceName(interface),
        NodeName(server),
        ServiceName(service),
        size_class,
        measured,
        Histogram(),
        processing if processing is not None else Histogram(),
        requests=measured.total,
        missed=round(measured.count_over(deadline_s)),
    )


def stream(number: int) -> StreamId:
    return StreamId(number)
