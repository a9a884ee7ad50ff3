"""Measures what becomes of requests after one of two paths goes silent while its interface stays up.

50 requests a second of 1 kB, with answers of 1 kB, go over plain kernel cables. The path that carried more of the
warm-up is cut in the middle of the network, both ways: for a contender that uses one path at a time, that is the one in
use. The clients are bare programs, ours a sidecar's engine with the application in its process; every server answers
on the thread that received the request.

Ours and plain UDP run again with real-time priority on processors that do not sleep (`_steady_`): the difference is
the cost of the machine's other work and its sleep.
"""

from __future__ import annotations

import contextlib
import time
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from bench.dataplane.ours import Ours
from bench.dataplane.remote import Remote
from bench.dataplane.section import Findings, Plot, Section, table_of
from bench.dataplane.statistics import Calls, Row, interval, median, median_ratio, p99, ratio, worst
from bench.dataplane.steady import awake, realtime
from bench.dataplane.topology import CARRIERS, CLOUD, ROBOT, SilentCut, allow_multipath, cables
from lab import Lab

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from bench.dataplane.section import Context
    from bench.reporting.tables import Figure
    from lab import Host

SIZE = 1_000
RATE_HZ = 50.0
BEFORE = 75
"""Requests before the cut."""
AFTER = 410
"""Requests due after it; one that leaves during the cut does not count."""
GRACE_S = 3.0
"""Longest wait for the last answers."""
ZENOH_PORTS = (7447, 7448)
ZENOH_LEASE_MS = 1_000
"""Zenoh's default is 10 s; with it, nothing is answered before a run ends."""
NAMES = {
    "blackhole": "ours",
    "blackhole_steady": "ours, steady",
    "udp": "plain UDP on both",
    "udp_steady": "plain UDP on both, steady",
    "tcp": "TCP",
    "mptcp": "kernel MPTCP",
    "zenoh_multilink": "zenoh, two links",
    "zenoh_sessions": "zenoh, two sessions",
}


@dataclass(frozen=True, slots=True)
class World:
    """The lab of this section."""

    lab: Lab
    context: Context
    robot: Host
    cloud: Host
    before: tuple[str, ...] = ()
    """The command that starts every program."""

    def remote(self, program: str, host: Host, side: str) -> Remote:
        """Start a program."""
        return Remote.start(program, self.context.folder, host=host, name=f"{program}.{side}", before=self.before)


def measure(context: Context) -> Findings:
    """Measure."""
    runs: dict[str, list[tuple[Calls, float]]] = {}
    notes = []
    with Lab(cables()) as lab:
        world = World(lab, context, lab.host(ROBOT), lab.host(CLOUD))
        for repeat in range(context.repeats):
            for key, start in _CONTENDERS.items():
                context.say(f"blackhole: {NAMES[key]}, {repeat + 1} of {context.repeats}")
                try:
                    with start(world) as client:
                        runs.setdefault(key, []).append(_run(world, client))
                except Exception as error:  # such as a kernel without MPTCP: the others go on
                    notes.append(f"{NAMES[key]}, repeat {repeat + 1}: {error}".splitlines()[0])
    rows = {key: [calls.between(cut).row(NAMES[key]) for calls, cut in repeats] for key, repeats in runs.items()}
    figures = _figures(rows)
    ours = [value for calls, cut in runs.get("blackhole", []) for value in calls.between(cut).answered_ms()]
    theirs = [value for calls, cut in runs.get("mptcp", []) for value in calls.between(cut).answered_ms()]
    our_worsts, their_worsts = (
        [row.max_ms for row in rows.get(key, []) if row.max_ms is not None] for key in ("blackhole", "mptcp")
    )
    figures["blackhole_p99_ms"] = p99(ours)
    figures["blackhole_mptcp_p99_over_ours"] = ratio(p99(theirs), p99(ours))
    figures["blackhole_mptcp_worst_over_ours"] = median_ratio(their_worsts, our_worsts)
    lines = {NAMES[key]: repeats[-1][0].line(repeats[-1][1]) for key, repeats in runs.items()}
    return Findings(
        figures=figures,
        intervals={
            "blackhole_p99_ms": interval(p99, ours),
            "blackhole_mptcp_worst_over_ours": interval(median_ratio, their_worsts, our_worsts),
        },
        tables=[table_of("requests after the cut", [Row.of_repeats(repeats) for repeats in rows.values()])],
        plots=[Plot("last repeat", "seconds after the cut", "latency, ms", lines=lines, log_y=True)],
        notes=notes,
    )


def _figures(rows: dict[str, list[Row]]) -> dict[str, Figure]:
    figures: dict[str, Figure] = {}
    for key in NAMES:
        repeats = rows.get(key, [])
        figures[f"{key}_lost"] = sum(row.lost for row in repeats) if repeats else None
        figures[f"{key}_p99_ms"] = median(row.p99_ms for row in repeats)
        figures[f"{key}_max_ms"] = worst(row.max_ms for row in repeats)
    figures["mptcp_worst_ms"] = figures.pop("mptcp_max_ms")
    figures["blackhole_p99_ms_of_repeats"] = figures["blackhole_p99_ms"]
    figures["blackhole_mptcp_worst_over_ours_of_repeats"] = median(
        ratio(theirs.max_ms, ours.max_ms)
        for theirs, ours in zip(rows.get("mptcp", []), rows.get("blackhole", []), strict=False)
    )
    return figures


def _run(world: World, client: Remote) -> tuple[Calls, float]:
    """Warm up, cut the busier path in the middle of a run; return the run and the time of the cut."""
    before = _sent_bytes(world.robot)
    client.ask("call", size=SIZE, count=BEFORE // 2, rate_hz=RATE_HZ, grace_s=GRACE_S)
    after = _sent_bytes(world.robot)
    busier = max(CARRIERS, key=lambda name: after[name] - before[name])
    count = BEFORE + world.context.scaled(AFTER)
    client.begin("call", size=SIZE, count=count, rate_hz=RATE_HZ, grace_s=GRACE_S)
    time.sleep(BEFORE / RATE_HZ)
    cut = SilentCut(world.lab)
    cut.cut(busier)
    moment = time.monotonic()
    try:
        return Calls.of(client.finish(timeout_s=120.0)), moment
    finally:
        cut.mend()


def _sent_bytes(host: Host) -> dict[str, int]:
    """Return the bytes that left by each interface so far."""
    found = {}
    for line in host.run(["cat", "/proc/net/dev"], check=True).stdout.splitlines():
        name, colon, counters = line.partition(":")
        if colon:
            found[name.strip()] = int(counters.split()[8])
    return found


# -- contenders: each gives a client that is connected and ready to call ------------------------------------------


@contextlib.contextmanager
def _ours(world: World) -> Iterator[Remote]:
    with Ours.in_lab(world.lab, world.context.folder, answer_bytes=SIZE, before=world.before) as ours:
        yield ours.robot


@contextlib.contextmanager
def _udp(world: World) -> Iterator[Remote]:
    with world.remote("udp", world.cloud, "server") as server, world.remote("udp", world.robot, "client") as client:
        port = server.ask("listen", answer_bytes=SIZE)
        client.ask("connect", paths=[(carrier, world.cloud.address(), port) for carrier in CARRIERS])
        yield client


@contextlib.contextmanager
def _steady(start: Callable[[World], contextlib.AbstractContextManager[Remote]], world: World) -> Iterator[Remote]:
    """Yield the same contender, undisturbed if the kernel lets us; raises RuntimeError if it does not."""
    with awake() as kept_awake:
        if not kept_awake or not realtime():
            raise RuntimeError("no real-time priority, or no say in how processors sleep")
        with start(replace(world, before=realtime())) as client:
            yield client


@contextlib.contextmanager
def _stream(world: World, *, multipath: bool) -> Iterator[Remote]:
    with world.remote("tcp", world.cloud, "server") as server, world.remote("tcp", world.robot, "client") as client:
        port = server.ask("listen", answer_bytes=SIZE, multipath=multipath)
        client.ask("connect", host=world.cloud.address(), port=port, multipath=multipath)
        yield client


def _tcp(world: World) -> contextlib.AbstractContextManager[Remote]:
    return _stream(world, multipath=False)


@contextlib.contextmanager
def _mptcp(world: World) -> Iterator[Remote]:
    allow_multipath(world.robot, world.cloud)
    with _stream(world, multipath=True) as client:
        client.ask("call", size=SIZE, count=5, rate_hz=RATE_HZ)
        if client.ask("subflows") != 1:
            raise RuntimeError("the second subflow did not come up")
        yield client


@contextlib.contextmanager
def _zenoh(world: World, *, sessions: bool) -> Iterator[Remote]:
    ports = ZENOH_PORTS if sessions else (ZENOH_PORTS[0],) * 2
    endpoints = [
        f"tcp/{world.cloud.address()}:{port}#iface={carrier}" for port, carrier in zip(ports, CARRIERS, strict=True)
    ]
    common = {"max_links": 1 if sessions else len(CARRIERS), "lease_ms": ZENOH_LEASE_MS}
    with world.remote("zenoh", world.cloud, "server") as server, world.remote("zenoh", world.robot, "client") as client:
        server.ask("listen", ports=sorted(set(ports)), answer_bytes=SIZE, **common)
        client.ask("connect", sessions=[[end] for end in endpoints] if sessions else [endpoints], **common)
        yield client


def _zenoh_multilink(world: World) -> contextlib.AbstractContextManager[Remote]:
    return _zenoh(world, sessions=False)


def _zenoh_sessions(world: World) -> contextlib.AbstractContextManager[Remote]:
    return _zenoh(world, sessions=True)


_CONTENDERS: dict[str, Callable[[World], contextlib.AbstractContextManager[Remote]]] = {
    "blackhole": _ours,
    "blackhole_steady": lambda world: _steady(_ours, world),
    "udp": _udp,
    "udp_steady": lambda world: _steady(_udp, world),
    "tcp": _tcp,
    "mptcp": _mptcp,
    "zenoh_multilink": _zenoh_multilink,
    "zenoh_sessions": _zenoh_sessions,
}

SECTION = Section("blackhole", "A path goes silent", measure)
