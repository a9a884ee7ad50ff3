"""Runs our data plane as a program: a sidecar's engine, interface threads and sockets, without ROS and control plane.

This process itself is the application: the robot's side sends the requests of a plan, the cloud's side answers each
with its beginning. The controller supplies what the control plane would push (peers, mapping).
"""

from __future__ import annotations

import base64
import logging
import random
import sys
import threading
import time
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

from bench.dataplane.calling import HEADER, Caller, Plan, usage
from bench.dataplane.remote import serve
from bench.null_cipher import install
from plr.protos.model.ids import InterfaceName, NodeName, Role, ServiceName, SessionId, Version
from plr.protos.model.mapping import Assignment, MappingSet, ServiceMapping
from plr.protos.model.members import ALL_CALLS, Candidate, CandidateKind, Peer, PeerSet, ServiceOffer
from plr.protos.program import interpreter
from plr.protos.trust.clock_floor import ClockFloor
from plr.protos.trust.pair_token import pair_token
from plr.sidecar.config.sidecar import SidecarConfig
from plr.sidecar.core.base.values import RequestId
from plr.sidecar.core.engine.engine import EngineConfig
from plr.sidecar.core.seam.application import (
    CarriedService,
    ExecuteRequest,
    OfferService,
    RequestFailed,
    ResponseArrived,
)
from plr.sidecar.net.dataplane import DataPlaneHooks, ThreadedDataPlane
from plr.sidecar.net.interface_manager import InterfaceManager
from plr.sidecar.state.start_session import start_session

if TYPE_CHECKING:
    from collections.abc import Sequence

    from plr.protos.trust.credential import SessionCredential
    from plr.sidecar.core.seam.application import ApplicationEvent

SERVICE = ServiceName("/bench")
TYPE = "bench/srv/Bytes"
READY_TIMEOUT_S = 20.0


class EngineProgram:
    """One sidecar's data plane."""

    def __init__(self) -> None:
        self._role = Role.ROBOT
        self._caller = Caller(self._submit)
        self._failed: list[str] = []
        self._one_way: list[tuple[int, float]] = []
        self._answer_bytes = HEADER.size
        self._candidates: tuple[Candidate, ...] = ()
        self._offered = threading.Event()
        self._have_candidates = threading.Event()
        self._version = 0

    # -- questions ------------------------------------------------------------------------------------------------

    def start(
        self, config: dict[str, Any], answer_bytes: int = HEADER.size, *, null_cipher: bool = False
    ) -> dict[str, Any]:
        """Open the interfaces of a sidecar's configuration; return it as a peer, for the other side's `meet`."""
        if null_cipher:
            install()
        parsed = SidecarConfig.model_validate(
            {"control_plane": "127.0.0.1:1", "insecure": True, "metrics_listen": None, **config}
        )
        self._role, self._answer_bytes = parsed.role, answer_bytes
        logging.basicConfig(level=parsed.log_level.name, stream=sys.stderr, format="%(asctime)s %(name)s %(message)s")
        interpreter.share()
        self._own = start_session(parsed.node_name, parsed.role, 1, None, ClockFloor(time.time))
        self._token = random.randbytes(16)
        hooks = DataPlaneHooks(self, lambda: None, lambda: None, lambda _: None, lambda *_: None)
        self._plane = ThreadedDataPlane(EngineConfig(parsed.role, parsed.service_rules()), self._own, hooks)
        self._interfaces = InterfaceManager(parsed, self._own, self._token, self._plane, self._on_candidates)
        self._plane.start()
        self._interfaces.start()
        if parsed.role is Role.CLOUD:
            rules = parsed.service_rules()
            self._plane.set_offers(tuple(ServiceOffer(ServiceName(rule.pattern), TYPE) for rule in rules))
        if not self._have_candidates.wait(READY_TIMEOUT_S):
            raise TimeoutError("no interface came into use")
        interpreter.settle()
        return described(self._own.credential, self._token, self._candidates)

    def meet(self, peers: list[dict[str, Any]], mapping: list[tuple[str, str]] | None = None) -> None:
        """Take these peers, and (robot) send every request over these (interface, server) pairs."""
        self._version += 1
        version = Version(self._version)
        known = tuple(peer_of(peer, self._own.credential) for peer in peers)
        error = self._plane.apply_peers(PeerSet(version, self._version, known))
        if error is None and mapping is not None:
            pairs = tuple(Assignment(InterfaceName(interface), NodeName(server)) for interface, server in mapping)
            services = (ServiceMapping(SERVICE, pairs),)
            error = self._plane.apply_mapping(MappingSet(version, self._version, services))
        if error is not None:
            raise ValueError(error)

    def wait_until_offered(self) -> None:
        """Robot: return when a path is up and the service can be called."""
        if not self._offered.wait(READY_TIMEOUT_S):
            raise TimeoutError("no path came up")
        self._plane.set_carried(frozenset({CarriedService(SERVICE)}))

    def call(self, **plan: Any) -> dict[str, Any]:
        """Robot: send the requests of a plan and return the log."""
        self._failed = []
        return {**self._caller.call(Plan(**plan)), "failed": self._failed}

    def take_one_way(self) -> list[tuple[int, float]]:
        """Cloud: return number and one-way seconds of every request since the last call."""
        taken, self._one_way = self._one_way, []
        return taken

    def usage(self) -> dict[str, Any]:
        """Return processor seconds, peak of resident bytes, threads."""
        return {**usage(), "threads": threading.active_count()}

    def counters(self) -> dict[str, Any]:
        """Return what the data plane counted."""
        engine = self._plane.engine_stats
        links = {}
        for link in self._plane.link_stats():
            links[link.interface] = {
                "bytes": dict(link.bytes),
                "datagrams": {" ".join(key): count for key, count in link.datagrams.items()},
                "dropped": dict(link.dropped),
                "paths": {peer: asdict(path) for peer, path in link.paths.items()},
            }
        return {"links": links, "dropped": dict(engine.dropped), "in_flight": engine.in_flight}

    def close(self) -> None:
        """Say goodbye and end."""
        if self._have_candidates.is_set():
            self._plane.stop()
            self._interfaces.stop()

    # -- plr.sidecar.ports.Application, on the data plane's threads ---------------------------------------------------

    def handle(self, event: ApplicationEvent) -> None:
        """Take an event."""
        now = time.monotonic()
        match event:
            case ResponseArrived():
                self._caller.answered(event.payload, now)
                self._plane.judge_answer(event.request_id, event.copy, None)
            case ExecuteRequest():
                number, sent = HEADER.unpack_from(event.payload)
                self._one_way.append((number, now - sent))
                self._plane.complete(event.execution, bytes(event.payload[: self._answer_bytes]), 0.0)
            case OfferService():
                self._offered.set()
            case RequestFailed():
                self._failed.append(event.reason)
            case _:
                pass

    # -- the application ------------------------------------------------------------------------------------------

    def _submit(self, number: int, data: bytes) -> None:
        # The session makes the id unique over several runs of the robot's side.
        request_id = RequestId(self._plane.session.to_bytes(8, "big") + (number & (1 << 64) - 1).to_bytes(8, "big"))
        self._plane.submit(request_id, SERVICE, data)

    # -- what the control plane would do --------------------------------------------------------------------------

    def _on_candidates(self, candidates: tuple[Candidate, ...], _: tuple[InterfaceName, ...]) -> None:
        self._candidates = candidates
        if candidates:
            self._have_candidates.set()


def described(credential: SessionCredential, token: bytes, candidates: Sequence[Candidate]) -> dict[str, Any]:
    """Describe ourselves as a peer, for the other side's `meet`."""
    return {
        "name": credential.name,
        "role": credential.role.value,
        "session": credential.session,
        "token": base64.b64encode(token).decode(),
        "credential": base64.b64encode(credential.encode()).decode(),
        "candidates": [
            {"interface_id": c.interface_id, "interface": c.interface, "kind": c.kind.value, "address": c.address}
            for c in candidates
        ],
    }


def peer_of(fields: dict[str, Any], receiver: SessionCredential) -> Peer:
    """Return the peer that was `described`, as the control plane would send it."""
    role = Role(fields["role"])
    candidates = tuple(
        Candidate(c["interface_id"], c["interface"], CandidateKind(c["kind"]), (c["address"][0], c["address"][1]))
        for c in fields["candidates"]
    )
    offers = (ServiceOffer(SERVICE, TYPE),) if role is Role.CLOUD else ()
    token = pair_token(base64.b64decode(fields["token"]), receiver.name, receiver.role)
    return Peer(
        fields["name"],
        role,
        SessionId(fields["session"]),
        token,
        1,
        candidates,
        offers,
        may_call=ALL_CALLS,
        credential=base64.b64decode(fields["credential"]),
    )


if __name__ == "__main__":
    serve(EngineProgram())
