"""Implements ways to get answers from a cloud over two carriers: each gives a client, or one for each carrier.

All of them run in the same lab: a robot with a carrier `a` and a carrier `b`, and two servers that take the same time
for a request, one request at a time. There is no NAT, since DDS does not pass one.
"""

from __future__ import annotations

import contextlib
import sys
from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING, Any

from bench.dataplane.remote import Remote
from bench.dataplane.topology import CARRIERS, CLOUDS, ROBOT, allow_multipath
from lab import HostSpec, InterfaceSpec, LabConfig, LinkProfile, server
from lab.system import System

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence
    from contextlib import AbstractContextManager
    from pathlib import Path

    from bench.evaluation.scenario import Traffic
    from lab import Host, Lab

    Clients = Sequence[Remote]
    """Clients that each send every request, at the same moments; the first answer counts."""

SERVICE = "/echo"
"""The service of `lab.echo`, which needs ROS."""
PATHS = dict(zip(CARRIERS, ("a", "b"), strict=True))
"""The robot's interface -> the path of the trace behind it."""
WARM = LinkProfile(delay_ms=20.0, rate_kbps=50_000.0)
"""Both links while all programs start and find each other: the same good network for all."""
FALLBACK = "/echo_here"
FALLBACK_TAKES = 0.15
"""Share of the deadline that the robot's own server takes for a request, with a smaller model: 150 ms of 1 s."""
BUDGET = 0.1
"""Budget of an interface, for the contenders that have one."""
ZENOH_PORT = 7447
ZENOH_LEASE_MS = 10_000
"""Zenoh's default: the TCP below survives shorter outages."""


@dataclass(frozen=True, slots=True)
class World:
    """The environment in which a contender is started."""

    lab: Lab
    folder: Path
    """Folder for configurations and logs."""
    traffic: Traffic
    notes: dict[str, Any] = field(default_factory=dict)
    """What a contender reports of its run at the end, for the record."""

    @property
    def robot(self) -> Host:
        """The host on which the client runs."""
        return self.lab.host(ROBOT)

    @property
    def clouds(self) -> tuple[Host, ...]:
        """The hosts on which servers run."""
        return tuple(self.lab.host(name) for name in CLOUDS)

    def service(self, cloud: str) -> dict[str, Any]:
        """Return how a cloud's server answers, in the form that the programs expect."""
        return {"answer_bytes": self.traffic.answer_bytes, "compute": self.traffic.compute(first=cloud == CLOUDS[0])}

    def start_ros_server(self, host: Host, **environment: str) -> None:
        """Start a ROS server; each request tells it how long to compute."""
        stall = self.traffic.compute(first=host.name == CLOUDS[0])
        argv = [sys.executable, "-m", "lab.echo", "serve"]
        if stall["stall_every"]:
            argv += ["--delay-ms", f"{stall['stall_s'] * 1e3:g}", "--delay-every", str(stall["stall_every"])]
        host.popen(argv, env=environment, log_path=self.folder / f"{host.name}.echo.log")

    def start_fallback(self, host: Host) -> None:
        """Start the robot's own ROS server; its requests state the computing time of the clouds."""
        delay_ms = max(0.0, FALLBACK_TAKES * self.traffic.deadline_ms - self.traffic.compute_ms)
        argv = [sys.executable, "-m", "lab.echo", "serve", "--service", FALLBACK, "--delay-ms", f"{delay_ms:g}"]
        host.popen(argv, log_path=self.folder / f"{host.name}.echo.log")

    @contextlib.contextmanager
    def ros_client(self, **environment: str) -> Iterator[Remote]:
        """Yield a ROS client that has found a server."""
        with self.remote("ros", self.robot, **environment) as client:
            client.ask("connect", answer_bytes=self.traffic.answer_bytes, compute_s=self.traffic.compute_ms / 1e3)
            yield client

    def remote(self, program: str, host: Host, **environment: str) -> Remote:
        """Start a measurement program."""
        return Remote.start(program, self.folder, host=host, name=f"{program}.{host.name}", environment=environment)


@dataclass(frozen=True, slots=True)
class Contender:
    """One way to get answers."""

    name: str
    about: str
    start: Callable[[World], AbstractContextManager[Clients]]
    carriers: tuple[str, ...] = CARRIERS
    """Interfaces that the robot has."""
    ablation: bool = False
    """Whether it is a variant of another contender, run only when requested by name."""

    def lab(self) -> LabConfig:
        """Return the lab that it needs."""
        interfaces = tuple(InterfaceSpec(name, nat=None, up=WARM, down=WARM) for name in self.carriers)
        return LabConfig(
            robots=(HostSpec(ROBOT, interfaces),), clouds=tuple(server(name) for name in CLOUDS), source_routing=True
        )


def _direct(world: World, *, carrier: str) -> Iterator[Clients]:
    cloud = world.clouds[0]
    # Multicast does not cross routers: each side is told the other's address.
    there = {"ROS_AUTOMATIC_DISCOVERY_RANGE": "SUBNET", "ROS_STATIC_PEERS": cloud.address()}
    here = {**there, "ROS_STATIC_PEERS": world.robot.address(carrier)}
    world.start_ros_server(cloud, **here)
    with world.ros_client(**there) as client:
        yield (client,)


def _mptcp(world: World) -> Iterator[Clients]:
    cloud = world.clouds[0]
    allow_multipath(world.robot, cloud)
    with world.remote("tcp", cloud) as listener, world.remote("tcp", world.robot) as client:
        port = listener.ask("listen", multipath=True, **world.service(cloud.name))
        client.ask("connect", host=cloud.address(), port=port, multipath=True)
        client.ask("call", size=1000, count=5, rate_hz=20.0)
        if client.ask("subflows") != 1:
            raise RuntimeError("the second subflow did not come up")
        yield (client,)


def _zenoh(world: World, *, drop: bool = False) -> Iterator[Clients]:
    common = {"max_links": 1, "lease_ms": ZENOH_LEASE_MS}
    with contextlib.ExitStack() as stack:
        for cloud in world.clouds:
            listener = stack.enter_context(world.remote("zenoh", cloud))
            listener.ask("listen", ports=[ZENOH_PORT], **common, **world.service(cloud.name))
        # One process per session: a session blocked by a full link must not hold up another.
        clients = []
        for cloud, carrier in zip(world.clouds, CARRIERS, strict=True):
            client = stack.enter_context(world.remote("zenoh", world.robot))
            endpoint = f"tcp/{cloud.address()}:{ZENOH_PORT}#iface={carrier}"
            client.ask("connect", sessions=[[endpoint]], **common, drop=drop)
            clients.append(client)
        yield tuple(clients)


def _plr(
    world: World,
    *,
    clouds: Sequence[str] = CLOUDS,
    carriers: Sequence[str] = CARRIERS,
    fallback: bool = False,
    redundancy: str = "replicate",
    extra_load: float | None = None,
) -> Iterator[Clients]:
    service = {
        "name": SERVICE,
        "deadline_ms": world.traffic.deadline_ms,
        "idempotent": True,
        "redundancy": redundancy,
    }
    if fallback:
        service["fallback"] = FALLBACK
    networks: dict[str, Any] = (
        {"networks": [{"interface": "*", "extra_load": extra_load}]} if extra_load is not None else {}
    )
    system = System(world.lab, world.folder)
    try:
        system.start_control_plane()
        for cloud in clouds:
            world.start_ros_server(world.lab.host(cloud))
            system.start_cloud(cloud, [{"name": SERVICE}])
        system.wait_for_offer(system.start_robot([service], interfaces=carriers, **networks))
        if fallback:
            world.start_fallback(world.robot)
            up = f'plr_fallback_up{{service="{SERVICE}"}}'
            system.wait("the fallback", lambda: system.metrics(ROBOT).get(up) == 1)
        with world.ros_client() as client:
            yield (client,)
            world.notes["explained"] = _explained(system)
            world.notes["counters"] = {
                series: value
                for series, value in system.metrics(ROBOT).items()
                if series.startswith(("plr_requests_total", "plr_copy_bytes_total", "plr_copies_", "plr_fallback"))
            }
    finally:
        system.close()


def _explained(system: System) -> list[str]:
    """Return what `plr explain` says about the interfaces that carried copies of the same requests."""
    return [
        f"{joint.first} and {joint.second}{f', both to {joint.server}' if joint.server else ''}: "
        f"both missed {joint.both_missed:.0f} of {joint.requests:.0f} "
        f"({joint.first} {joint.first_missed:.0f}, {joint.second} {joint.second_missed:.0f}), "
        f"{joint.expected:.2g} expected by chance ({joint.lift:.2g} times): {joint.correlation.value}"
        for joint in system.explain(ROBOT, SERVICE).joints
    ]


def _direct_over(name: str, carrier: str) -> Contender:
    return Contender(
        f"direct-{name}",
        f"ROS 2 straight over carrier {name}",
        contextlib.contextmanager(partial(_direct, carrier=carrier)),
        (carrier,),
    )


def _plr_of(interfaces: int, servers: int) -> Contender:
    carriers = CARRIERS[:interfaces]
    return Contender(
        f"plr-{interfaces}x{servers}",
        f"ours with the first {interfaces} of the carriers and {servers} of the servers",
        contextlib.contextmanager(partial(_plr, clouds=CLOUDS[:servers], carriers=carriers)),
        carriers,
        ablation=True,
    )


def _plr_in(redundancy: str, about: str) -> Contender:
    start = contextlib.contextmanager(partial(_plr, redundancy=redundancy))
    return Contender(f"plr-{redundancy}", f"ours: {about}", start)


def _plr_within_budget(redundancy: str) -> Contender:
    start = contextlib.contextmanager(partial(_plr, redundancy=redundancy, extra_load=BUDGET))
    about = f"plr-{redundancy}, further copies at most {BUDGET:.0%} of what was answered on each carrier"
    return Contender(f"plr-{redundancy}-{BUDGET:.0%}", about, start, ablation=True)


_ALL = (
    *(_direct_over(name, carrier) for carrier, name in PATHS.items()),
    Contender("mptcp", "one connection of the kernel's multipath TCP", contextlib.contextmanager(_mptcp)),
    Contender("zenoh", "a zenoh session over each carrier, first reply", contextlib.contextmanager(_zenoh)),
    _plr_in("replicate", "every request over both carriers, first answer"),
    _plr_in("adaptive", "a second copy as late as the target miss probability allows"),
    _plr_in("hedge", "a second copy when the answer takes longer than 95 % did"),
    _plr_in("single", "every request over the better carrier alone"),
    Contender(
        "plr-fallback",
        "plr-replicate, and a slower server on the robot for what the network misses",
        contextlib.contextmanager(partial(_plr, fallback=True)),
    ),
    Contender(
        "zenoh-drop",
        "the same, but a query that finds its session's queue full is dropped",
        contextlib.contextmanager(partial(_zenoh, drop=True)),
        ablation=True,
    ),
    *(_plr_within_budget(redundancy) for redundancy in ("adaptive", "hedge")),
    *(_plr_of(interfaces, servers) for interfaces, servers in ((1, 1), (1, 2), (2, 1))),
)
CONTENDERS = {contender.name: contender for contender in _ALL}
"""Contenders by name; the ideals (`bench.evaluation.ideal`) come in addition."""
