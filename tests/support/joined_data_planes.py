"""Two sidecars' data planes on loopback sockets: the real drivers, no namespaces."""

from __future__ import annotations

import contextlib
import queue
import random
import socket
import threading
import time
from dataclasses import replace
from typing import TYPE_CHECKING

from lab.simulated.sessions import session_of
from plr.protos.model.ids import InterfaceId, InterfaceName, NodeName, Role, ServiceName, SessionId, Version
from plr.protos.model.members import ALL_CALLS, Candidate, CandidateKind, Peer, PeerSet, ServiceOffer
from plr.protos.trust.pair_token import pair_token
from plr.sidecar.core.base.values import RequestId
from plr.sidecar.core.engine.engine import EngineConfig
from plr.sidecar.core.link.link import Link
from plr.sidecar.core.link.sender import LinkIdentity
from plr.sidecar.core.rules.service_rule import ServiceRule
from plr.sidecar.core.seam.application import ApplicationEvent, ExecuteRequest, ResponseArrived
from plr.sidecar.core.seam.links import SetReady
from plr.sidecar.net.dataplane import DataPlaneHooks, ThreadedDataPlane
from plr.sidecar.net.interface_thread import InterfaceThread

if TYPE_CHECKING:
    from collections.abc import Iterator

    from plr.protos.model.members import ServiceUse
    from plr.sidecar.core.link.pinging import Pong

SERVICE, TYPE = ServiceName("/echo"), "t/srv/Echo"
PATIENCE_S = 20.0
"""For a loaded machine; nothing here takes long."""


class Node:
    """A sidecar's data plane on one loopback socket; its application echoes and takes notes."""

    def __init__(self, name: str, role: Role, session: int) -> None:
        self.answers_at_once = False
        self.name, self.role, self.session = NodeName(name), role, SessionId(session)
        self.token = session.to_bytes(16, "big")
        self.offers = (ServiceOffer(SERVICE, TYPE),) if role is Role.CLOUD else ()
        self.events: list[ApplicationEvent] = []
        self.reach_changes = 0
        self.news = threading.Condition()
        config = EngineConfig(role, (ServiceRule(SERVICE, 5.0, 20.0, idempotent=True),))
        self.pongs: queue.SimpleQueue[Pong] = queue.SimpleQueue()
        self.uses_told: list[tuple[ServiceUse, ...]] = []
        hooks = DataPlaneHooks(
            self,
            lambda: self.uses_told.append(self.plane.services()[1]),
            self.count_reach,
            lambda _: None,
            lambda *_: None,
            pong=self.pongs.put,
        )
        own = self.own = session_of(name, role, session)
        self.plane = ThreadedDataPlane(config, own, hooks)
        sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        sock.setblocking(False)
        sock.bind(("127.0.0.1", 0))
        now = time.monotonic()
        identity = LinkIdentity.of(own.credential, self.token, InterfaceName("lo"), InterfaceId(0))
        self.thread = InterfaceThread(sock, Link(identity, random.Random(session), now), None, self.plane)

    def count_reach(self) -> None:
        self.reach_changes += 1

    def handle(self, event: ApplicationEvent) -> None:
        if isinstance(event, ExecuteRequest):
            arguments = (event.execution, b"echo:" + event.payload, 0.0)
            if self.answers_at_once:
                self.plane.complete(*arguments)
            else:
                threading.Thread(target=self.plane.complete, args=arguments).start()
        if isinstance(event, ResponseArrived):
            self.plane.judge_answer(event.request_id, event.copy, None)
        with self.news:
            self.events.append(event)
            self.news.notify_all()

    def told_to(self, other: Node) -> Peer:
        candidate = Candidate(InterfaceId(0), InterfaceName("lo"), CandidateKind.HOST, ("127.0.0.1", self.thread.port))
        token = pair_token(self.token, other.name, other.role)
        peer = Peer(self.name, self.role, self.session, token, 1, (candidate,), self.offers, may_call=ALL_CALLS)
        return replace(peer, credential=self.own.credential.encode())

    def start(self, other: Node) -> None:
        self.plane.start()
        self.thread.start()
        self.plane.set_links({InterfaceName("lo"): self.thread})
        self.thread.post(SetReady(ready=True))
        if self.offers:
            self.plane.set_offers(self.offers)
        assert self.plane.apply_peers(PeerSet(Version(1), 1, (other.told_to(self),))) is None

    def stop(self) -> None:
        self.plane.stop()
        self.thread.stop(PATIENCE_S)

    def wait_for(self, kind: type[ApplicationEvent], count: int = 1) -> list[ApplicationEvent]:
        def found() -> list[ApplicationEvent]:
            return [event for event in self.events if isinstance(event, kind)]

        with self.news:
            assert self.news.wait_for(lambda: len(found()) >= count, PATIENCE_S), self.events
        return found()


@contextlib.contextmanager
def joined(robot: Node, cloud: Node) -> Iterator[None]:
    """Let them know each other, until the end."""
    with contextlib.ExitStack() as stack:
        for node, other in ((robot, cloud), (cloud, robot)):
            stack.callback(node.stop)
            node.start(other)
        yield


def submit(robot: Node, number: int, payload: bytes) -> None:
    robot.plane.submit(RequestId(number.to_bytes(16, "big")), SERVICE, payload)
