"""Moves load between servers over an unchanging network: how long until the mapping follows?"""

from __future__ import annotations

import itertools
import random
import zlib
from dataclasses import dataclass
from typing import TYPE_CHECKING

from bench.matcher.crossed import pairs_of
from bench.matcher.online import replayed
from bench.matcher.races import PATHS, PROBE_INTERVAL_S, Probe, Race, Races, Workload

if TYPE_CHECKING:
    from collections.abc import Iterator

DEADLINE_S = 0.15
NETWORK_S, NETWORK_SIGMA = 0.02, 0.2
SLOW_S = 0.3
"""Time that the network takes for slow requests."""
IDLE_S, BUSY_S, COMPUTE_SIGMA = 0.02, 0.25, 0.25
SWAPS = 4
APART_S = (20.0, 80.0)
"""Range of the time between swaps, and before the first."""


@dataclass(frozen=True, slots=True)
class Scene:
    """A robot's interfaces and servers, of which one is busy at a time."""

    slow_shares: tuple[float, ...]
    """Share of each interface's requests that miss the deadline at any server."""
    servers: int
    per_second: float = 20.0


@dataclass(frozen=True, slots=True)
class Swap:
    """One move of the load."""

    at_s: float
    follow_s: float
    """Time until the mapping avoided the server that became busy; inf if it did not before the next swap."""
    late: int
    """Requests whose copies were all late meanwhile."""


def swap(scene: Scene, seed: int) -> Iterator[Swap]:
    """Let load move a few times, always to a server in use; the result is the same every time."""
    rng = random.Random(zlib.crc32(f"{scene} {seed}".encode()))
    at = list(itertools.accumulate(rng.uniform(*APART_S) for _ in range(SWAPS + 1)))
    busy = [rng.randrange(scene.servers)]
    for _ in range(SWAPS):
        busy.append(rng.choice([server for server in range(scene.servers) if server != busy[-1]]))
    interfaces = PATHS[: len(scene.slow_shares)]
    ticks = list(replayed(_races(scene, at, busy, seed, rng), DEADLINE_S, pairs_of(scene.servers, interfaces)))
    for number, (start, end) in enumerate(itertools.pairwise(at)):
        new = busy[number + 1]
        followed, late = float("inf"), 0
        for tick in ticks:
            if not start <= tick.at_s < end:
                continue
            if not _suffers(scene, tick.carried, new):
                followed = tick.at_s - start
                break
            late += tick.missed
        yield Swap(start, followed, late)


def _suffers(scene: Scene, carried: tuple[int, ...], busy: int) -> bool:
    """Return whether an interface uses the busy server needlessly, or the better one does where one of them must."""
    burdened = [divmod(pair, scene.servers)[0] for pair in carried if pair % scene.servers == busy]
    if scene.servers > len(scene.slow_shares):
        return bool(burdened)
    return any(scene.slow_shares[interface] == min(scene.slow_shares) for interface in burdened)


def _races(scene: Scene, at: list[float], busy: list[int], seed: int, rng: random.Random) -> Races:
    races: list[Race] = []
    probes: list[Probe] = []
    pairs = len(scene.slow_shares) * scene.servers
    stretch = 0
    for number in range(int(at[-1] * scene.per_second)):
        now = (number + rng.random()) / scene.per_second
        while now >= at[stretch]:
            stretch += 1
        while len(probes) // pairs * PROBE_INTERVAL_S < now:
            sent = len(probes) // pairs * PROBE_INTERVAL_S
            probes += [Probe(sent, path, _drawn(rng, NETWORK_S, NETWORK_SIGMA)) for path in range(pairs)]
        processing = tuple(
            _drawn(rng, BUSY_S if server == busy[stretch] else IDLE_S, COMPUTE_SIGMA) for server in range(scene.servers)
        )
        latency: list[float] = []
        for share in scene.slow_shares:
            network = SLOW_S if rng.random() < share else _drawn(rng, NETWORK_S, NETWORK_SIGMA)
            latency += [network + took for took in processing]
        races.append(Race(now, tuple(latency), processing * len(scene.slow_shares)))
    name = f"swaps {seed}"
    return Races(name, Workload(name, 1000, scene.per_second), at[-1], tuple(races), tuple(probes))


def _drawn(rng: random.Random, median_s: float, sigma: float) -> float:
    return median_s * rng.lognormvariate(0.0, sigma)
