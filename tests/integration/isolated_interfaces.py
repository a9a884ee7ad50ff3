"""A robot's data plane in this process, each interface a loopback address of its own; the cloud is a process apart.

Its sockets can be made to hang as a bad driver does (the call does not return, but lets the interpreter go on), or to
be full.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import itertools
import random
import socket
import threading
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Self

from bench.dataplane.programs.engine import TYPE, described, peer_of
from bench.dataplane.remote import Remote
from lab.simulated.sessions import session_of
from plr.protos.model.ids import InterfaceId, InterfaceName, NodeName, Role, ServiceName, SessionId, Version
from plr.protos.model.mapping import Assignment, MappingSet, ServiceMapping
from plr.protos.model.members import Candidate, CandidateKind, PeerSet, ServiceOffer
from plr.sidecar.core.base.values import RequestId
from plr.sidecar.core.engine.engine import EngineConfig
from plr.sidecar.core.link.link import Link
from plr.sidecar.core.link.sender import LinkIdentity
from plr.sidecar.core.rules.service_rule import ServiceRule
from plr.sidecar.core.seam.application import (
    ApplicationEvent,
    CarriedService,
    OfferService,
    RequestFailed,
    ResponseArrived,
)
from plr.sidecar.core.seam.links import SetReady
from plr.sidecar.net.dataplane import DataPlaneHooks, ThreadedDataPlane
from plr.sidecar.net.interface_thread import InterfaceThread

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

PATIENCE_S = 30.0
LIFETIME_S = 60.0
URGENT_S = 1.0
SESSION = SessionId(77)
TOKEN = bytes(15) + b"r"


FULL_PAUSE_S = 0.002


class BadSocket(socket.socket):
    """Its sends take `hang_s` each; while it is `full` it takes nothing."""

    hang_s = 0.0
    full = False

    def sendto(self, *arguments: Any) -> int:
        self._suffer()
        self.sent.append(len(arguments[0]))
        return super().sendto(*arguments)

    def sendmsg(self, *arguments: Any) -> int:
        self._suffer()
        self.sent.append(len(arguments[0][0]))
        return super().sendmsg(*arguments)

    @functools.cached_property
    def sent(self) -> list[int]:
        """Bytes of each send that succeeded."""
        return []

    def _suffer(self) -> None:
        if self.hang_s:
            time.sleep(self.hang_s)
        if self.full:
            # The kernel calls this socket writable all the time, unlike one that is full: without a pause its thread
            # would spin, and all others would wait for the interpreter.
            time.sleep(FULL_PAUSE_S)
            raise BlockingIOError


@dataclass(slots=True)
class Call:
    """One request."""

    sent_s: float
    latency_s: float | None = None
    interface: str | None = None


class Robot:
    """The robot and its clouds. Use it in a `with` block."""

    def __init__(self, folder: Path, interfaces: tuple[str, ...], mapping: Mapping[str, tuple[str, str]]) -> None:
        """`mapping`: for each service over which interface it goes to which cloud, alone; the first is urgent."""
        self.calls: dict[str, list[Call]] = {service: [] for service in mapping}
        self._by_id: dict[RequestId, Call] = {}
        self._numbers = itertools.count()
        """Taken by several threads."""
        self._news = threading.Condition()
        self._offered: set[str] = set()
        self._stack = contextlib.ExitStack()
        services = [ServiceName(service) for service in mapping]
        deadline_s = dict.fromkeys(services, LIFETIME_S) | {services[0]: URGENT_S}
        rules = tuple(ServiceRule(service, deadline_s[service], LIFETIME_S) for service in services)
        hooks = DataPlaneHooks(self, lambda: None, lambda: None, lambda _: None, lambda *_: None)
        own = session_of("robot", Role.ROBOT, SESSION)
        self.plane = ThreadedDataPlane(EngineConfig(Role.ROBOT, rules), own, hooks)
        self.sockets: dict[str, BadSocket] = {}
        self.threads: dict[str, InterfaceThread] = {}
        candidates = []
        for number, name in enumerate(interfaces):
            sock = self.sockets[name] = BadSocket(socket.AF_INET, socket.SOCK_DGRAM)
            sock.setblocking(False)
            sock.bind((f"127.0.0.{number + 1}", 0))
            identity = LinkIdentity.of(own.credential, TOKEN, InterfaceName(name), InterfaceId(number))
            link = Link(identity, random.Random(number), time.monotonic())
            self.threads[name] = InterfaceThread(sock, link, None, self.plane)
            host, port = sock.getsockname()
            candidates.append(Candidate(identity.interface_id, identity.interface, CandidateKind.HOST, (host, port)))
        me = described(own.credential, TOKEN, candidates)
        clouds = sorted({cloud for _, cloud in mapping.values()})
        self.clouds = {name: self._stack.enter_context(Remote.start("engine", folder, name=name)) for name in clouds}
        peers = []
        for name, cloud in self.clouds.items():
            config = {
                "name": name,
                "role": "cloud",
                "interfaces": ["lo"],
                "stun": {"enabled": False},
                "udp_port": 0,
                "log_level": "warning",
                "services": [{"name": service} for service in services],
            }
            offers = tuple(ServiceOffer(service, TYPE) for service in services if mapping[service][1] == name)
            peers.append(dataclasses.replace(peer_of(cloud.ask("start", config=config), own.credential), offers=offers))
            cloud.ask("meet", peers=[me])
        self.plane.start()
        for thread in self.threads.values():
            thread.start()
            thread.post(SetReady(ready=True))
        self.plane.set_links({InterfaceName(name): thread for name, thread in self.threads.items()})
        assert self.plane.apply_peers(PeerSet(Version(1), 1, tuple(peers))) is None
        pairs = {
            service: (Assignment(InterfaceName(interface), NodeName(cloud)),)
            for service, (interface, cloud) in mapping.items()
        }
        mappings = tuple(ServiceMapping(ServiceName(service), assigned) for service, assigned in pairs.items())
        assert self.plane.apply_mapping(MappingSet(Version(1), 1, mappings)) is None
        with self._news:
            assert self._news.wait_for(lambda: self._offered == set(services), PATIENCE_S)
        self.plane.set_carried(frozenset(map(CarriedService, services)))

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        for sock in self.sockets.values():
            sock.hang_s, sock.full = 0.0, False
        self.plane.stop()
        for thread in self.threads.values():
            thread.stop(PATIENCE_S)
        self._stack.close()

    def handle(self, event: ApplicationEvent) -> None:
        """Take what the data plane tells the application."""
        now = time.monotonic()
        with self._news:
            match event:
                case ResponseArrived():
                    call = self._by_id[event.request_id]
                    call.latency_s, call.interface = now - call.sent_s, event.interface
                    self.plane.judge_answer(event.request_id, event.copy, None)
                case OfferService():
                    self._offered.add(event.name)
                case RequestFailed():
                    raise AssertionError(event)
                case _:
                    pass
            self._news.notify_all()

    def submit(self, service: str, size: int) -> Call:
        """Send a request."""
        call = Call(time.monotonic())
        request = RequestId(next(self._numbers).to_bytes(16, "big"))
        self._by_id[request] = call
        self.calls[service].append(call)
        # The cloud answers with the beginning of the request.
        self.plane.submit(request, ServiceName(service), bytes(size))
        return call

    def wait_for_answers(self, calls: list[Call]) -> None:
        """Wait until all of these are answered."""
        with self._news:
            done = self._news.wait_for(lambda: all(call.latency_s is not None for call in calls), PATIENCE_S)
        assert done, f"{sum(call.latency_s is None for call in calls)} of {len(calls)} unanswered"

    def beat(self, service: str, seconds: float, rate_hz: float = 50.0, size: int = 1000) -> list[Call]:
        """Send small requests at a rate and wait for their answers."""
        calls = []
        start = time.monotonic()
        for position in range(int(seconds * rate_hz)):
            time.sleep(max(0.0, start + position / rate_hz - time.monotonic()))
            calls.append(self.submit(service, size))
        self.wait_for_answers(calls)
        return calls


def latencies(calls: list[Call]) -> list[float]:
    """Seconds, the shortest first."""
    return sorted(call.latency_s for call in calls if call.latency_s is not None)
