"""CPU cost of the data plane's cores: a robot's and a cloud's engine and link, joined directly, without sockets.

Time inside the cores is simulated (every datagram takes half a millisecond), the CPU time is real. Prints one line
for each kind of traffic; `--profile` shows where the time goes.
"""

from __future__ import annotations

import argparse
import cProfile
import pstats
import random
import time
from collections import defaultdict
from dataclasses import dataclass
from typing import TYPE_CHECKING

from bench.null_cipher import null_cipher
from plr.protos.model.ids import InterfaceId, InterfaceName, NodeName, Role, ServiceName, Version
from plr.protos.model.members import ALL_CALLS, Candidate, CandidateKind, Peer, PeerSet, ServiceOffer
from plr.protos.trust.clock_floor import ClockFloor
from plr.protos.trust.pair_token import pair_token
from plr.sidecar.core.base.values import RequestId
from plr.sidecar.core.engine.engine import Engine, EngineConfig
from plr.sidecar.core.link.link import Link
from plr.sidecar.core.link.sender import LinkIdentity
from plr.sidecar.core.path.congestion.choice import CONTROLLERS, DEFAULT_CONTROLLER
from plr.sidecar.core.rules.service_rule import ServiceRule
from plr.sidecar.core.seam.application import ExecuteRequest, RequestFailed, ResponseArrived
from plr.sidecar.core.seam.links import SetReady
from plr.sidecar.core.wire.frame import BASE_SYMBOL_BYTES, symbol_count
from plr.sidecar.state.start_session import start_session

if TYPE_CHECKING:
    from collections.abc import Iterator

    from plr.sidecar.core.link.sender import Batch

SERVICE = ServiceName("/bench")
TYPE = "bench/srv/Bytes"
ONE_WAY_S = 0.0005
ANSWER = bytes(1000)


class Side:
    """One sidecar with one interface."""

    def __init__(self, name: str, role: Role, session: int, controller: str, now: float) -> None:
        self.name, self.role = NodeName(name), role
        self.token = session.to_bytes(16, "big")
        self.address = (name, 1)
        self.own = start_session(self.name, role, 1, None, ClockFloor(time.time))
        self.session = self.own.credential.session
        self.engine = Engine(EngineConfig(role, (ServiceRule("/*", 10.0, 60.0, idempotent=True),)), self.own, now)
        interface = InterfaceName("eth0")
        identity = LinkIdentity.of(self.own.credential, self.token, interface, InterfaceId(0))
        self.link = Link(identity, random.Random(session), now, controller=controller)
        self.link.execute(SetReady(ready=True), now)
        self.engine.set_interfaces([interface], now)
        self.offers = (ServiceOffer(SERVICE, TYPE),) if role is Role.CLOUD else ()
        if role is Role.CLOUD:
            self.engine.cloud.set_offers(self.offers)
        self.answered = 0
        self.datagrams = 0

    def told_to(self, other: Side) -> Peer:
        """Return what the control plane would send to the other side."""
        candidate = Candidate(InterfaceId(0), InterfaceName("eth0"), CandidateKind.HOST, self.address)
        return Peer(
            self.name,
            self.role,
            self.session,
            pair_token(self.token, other.name, other.role),
            1,
            (candidate,),
            self.offers,
            may_call=ALL_CALLS,
            credential=self.own.credential.encode(),
        )

    def turn(self, now: float) -> list[Batch]:
        """Let engine and link exchange messages until both are done; return what leaves."""
        engine, link = self.engine, self.link
        out: list[Batch] = []
        while True:
            while (event := link.next_event()) is not None:
                engine.on_link_event(event, now)
            for application_event in engine.take_events():
                if isinstance(application_event, ExecuteRequest):
                    engine.cloud.complete(application_event.execution, ANSWER, 0.0, now)
                elif isinstance(application_event, ResponseArrived):
                    self.answered += 1
                    engine.robot.requests.judge_answer(application_event.request_id, application_event.copy, None, now)
                elif isinstance(application_event, RequestFailed):
                    raise SystemExit(f"a request failed: {application_event.reason}")
            for _, command in engine.take_commands():
                link.execute(command, now)
            batches = link.batches_to_send(now)
            if not batches:
                self.datagrams += sum(batch.datagrams for batch in out)
                return out
            out += batches


class Pair:
    """The robot, the cloud and the simulated clock; a side receives `batch` datagrams before it gets its turn."""

    def __init__(self, batch: int, controller: str) -> None:
        self.now = 1.0
        self.batch = batch
        self.robot = Side("robot", Role.ROBOT, 1, controller, self.now)
        self.cloud = Side("cloud", Role.CLOUD, 2, controller, self.now)
        self.sent = 0
        self.early: defaultdict[NodeName, list[Batch]] = defaultdict(list)
        """Datagrams that left in the turns between two batches and are still to be carried."""
        for side, other in ((self.robot, self.cloud), (self.cloud, self.robot)):
            side.engine.apply_peers(PeerSet(Version(1), 1, (other.told_to(side),)), self.now)
        while SERVICE not in {use.name for use in self._carried()}:
            self.step()

    def _carried(self) -> list[ServiceOffer]:
        return [ServiceOffer(name, kind) for name, kind in self.robot.engine.robot.catalog.offered.items()]

    def step(self) -> None:
        """Carry one flight of datagrams each way, or let time pass until a timer is due."""
        flights = [
            (other, self.early.pop(side.name, []) + side.turn(self.now))
            for side, other in ((self.robot, self.cloud), (self.cloud, self.robot))
        ]
        if any(flight for _, flight in flights):
            self.now += ONE_WAY_S
        else:
            sides = (self.robot, self.cloud)
            self.now = max(self.now, min(min(s.link.next_timer(), s.engine.next_timer()) for s in sides))
        for receiver, flight in flights:
            source = self.cloud.address if receiver is self.robot else self.robot.address
            for turn in turns(flight, self.batch):
                for data, segment in turn:
                    receiver.link.receive_batch(data, segment, source, self.now)
                self.early[receiver.name] += receiver.turn(self.now)
        for side in (self.robot, self.cloud):
            side.engine.handle_timer(self.now)
            side.link.handle_timer(self.now)

    def call(self, payload: bytes, at_once: int) -> None:
        """Send `at_once` requests and wait for all their answers."""
        wanted = self.robot.answered + at_once
        requests = self.robot.engine.robot.requests
        for _ in range(at_once):
            self.sent += 1
            requests.submit(RequestId(self.sent.to_bytes(16, "big")), SERVICE, payload, self.now)
        while self.robot.answered < wanted:
            self.step()


def turns(flight: list[Batch], most: int) -> Iterator[list[tuple[memoryview, int]]]:
    """Cut a flight into the datagrams received in one turn: about `most` at once, as the kernel joins them."""
    turn: list[tuple[memoryview, int]] = []
    room = most
    for _, data, segment in flight:
        view = memoryview(data)
        while view:
            run, view = view[: room * segment], view[room * segment :]
            turn.append((run, segment))
            room -= -(-len(run) // segment)
            if room <= 0:
                yield turn
                turn, room = [], most
    if turn:
        yield turn


@dataclass(frozen=True)
class Traffic:
    """The traffic that one line of the table measures."""

    name: str
    size: int
    at_once: int
    rounds: int


TRAFFIC = (
    Traffic("1 kB, one at a time", 1000, 1, 2000),
    Traffic("1 kB, 32 at once", 1000, 32, 60),
    Traffic("150 kB, one at a time", 150_000, 1, 100),
    Traffic("150 kB, 8 at once", 150_000, 8, 15),
    Traffic("16 MiB, one at a time", 16 * 1024 * 1024, 1, 2),
)


def measure(traffic: Traffic, batch: int, controller: str) -> tuple[str, float]:
    """Run one kind of traffic; return a description of its cost, and the Mbit of payload carried per CPU second."""
    pair = Pair(batch, controller)
    payload = random.Random(1).randbytes(traffic.size)
    pair.call(payload, traffic.at_once)  # warm: windows grow, caches fill
    before = pair.robot.datagrams + pair.cloud.datagrams
    start = time.process_time()
    for _ in range(traffic.rounds):
        pair.call(payload, traffic.at_once)
    cpu_s = time.process_time() - start
    requests = traffic.rounds * traffic.at_once
    datagrams = (pair.robot.datagrams + pair.cloud.datagrams - before) / requests
    fragments = requests * (symbol_count(traffic.size, BASE_SYMBOL_BYTES) + 1)
    line = (
        f"{traffic.name:24s} {cpu_s / requests * 1e6:12.0f} {datagrams:12.1f} "
        f"{fragments / cpu_s:14.0f} {requests * traffic.size / cpu_s / 1e6:10.1f}"
    )
    return line, requests * traffic.size / cpu_s * 8 / 1e6


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--profile", action="store_true", help="show the functions that cost most")
    parser.add_argument("--only", default="", help="run only the kinds of traffic whose name contains this")
    parser.add_argument(
        "--batch", type=int, default=16, help="datagrams received between two turns of a side (default 16)"
    )
    parser.add_argument(
        "--controller", choices=sorted(CONTROLLERS), default=DEFAULT_CONTROLLER, help="the paths' congestion controller"
    )
    arguments = parser.parse_args()
    chosen = [traffic for traffic in TRAFFIC if arguments.only in traffic.name]
    print(
        f"{'both cores together':24s} {'us/request':>12s} {'datagrams':>12s} {'fragments/s':>14s} {'MB/s':>10s}"
        f" {'goodput_null_cipher_mbit_s':>26s} {'sealed_over_null_goodput':>24s}"
    )
    for traffic in chosen:
        if arguments.profile:
            with cProfile.Profile() as profile:
                line, _ = measure(traffic, arguments.batch, arguments.controller)
            print(line)
            pstats.Stats(profile).sort_stats("tottime").print_stats(25)
        else:
            line, sealed = measure(traffic, arguments.batch, arguments.controller)
            with null_cipher():
                _, clear = measure(traffic, arguments.batch, arguments.controller)
            print(f"{line} {clear:26.0f} {sealed / clear:24.2f}")


if __name__ == "__main__":
    main()
