"""Requests over two paths whose rates change as a scenario's trace says, in simulated time, with the real cores.

`python -m tests.sim.drives --traces FOLDER` prints what each redundancy mode misses and costs on recorded drives
(docs/use/redundancy.md). Links are first in, first out, as those of `bench.evaluation.ideal`. Only the rates, delays
and losses of the trace disturb anybody.
"""

from __future__ import annotations

import argparse
import fnmatch
import math
import random
import sys
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING

from bench.evaluation.scenario import Scenario, read_scenarios
from lab.trace_folder import read_folder
from plr.controlplane.planning.fifo import FifoLink
from plr.protos.model.redundancy_mode import RedundancyMode
from tests.sim.test_mesh import mapped
from tests.support.mesh import IPV6, Mesh, Node, rule

if TYPE_CHECKING:
    from collections.abc import Sequence

    from plr.protos.model.ids import Address
    from plr.sidecar.core.rules.budget import Budget

STARTING_S = 1.0
WARM_S = 4.0
"""Of requests over a good network before the window."""
WARM_BYTES_PER_S, WARM_DELAY_S = 6.25e6, 0.02
IP_HEADERS = 28
PATHS = ("a", "b")
CLOUDS = ("cloud-a", "cloud-b")


@dataclass(frozen=True)
class Driven:
    """What came of a window."""

    requests: int
    misses: int
    sent: int
    """Bytes of IP packets that the robot sent in the window."""
    first: int
    extra: int
    """Bytes of copies, as budgets count them; the warm-up included."""


class DatagramLink(FifoLink):
    """One direction of a path: what is lost stays lost."""

    sent = 0

    def carry(self, at: float, size: int, rng: random.Random) -> float:
        """When a datagram of this many bytes, headers included, has arrived; inf: never."""
        self.sent += size
        arrives = self.send(at, size, rng)
        loss = self._losses[self._step(at)]
        return math.inf if loss and rng.random() < loss else arrives

    def _lost(self, at: float, packets: int, rng: random.Random) -> int:
        return 0


class DriveMesh(Mesh):
    """The robot's interface a is behind path a of the trace, b behind b, whichever cloud is at the other end."""

    def __init__(self, scenario: Scenario) -> None:
        super().__init__(seed=1)
        self.dual_stack = True  # as the hosts of the lab
        trace = scenario.trace()
        self.begins = self.now + STARTING_S + WARM_S
        self.losses = random.Random(1)
        self.links = {(name, up): DatagramLink(trace.path(name), up=up) for name in PATHS for up in (True, False)}
        self._warm_busy_until = dict.fromkeys(self.links, 0.0)

    def _carry(self, source: Address, destination: Address, data: bytes) -> None:
        up = source[0].startswith("robot.")
        name = (source if up else destination)[0].removesuffix(IPV6).rsplit(".", 1)[1]
        if self.now < self.begins:
            left = max(self.now, self._warm_busy_until[name, up]) + len(data) / WARM_BYTES_PER_S
            self._warm_busy_until[name, up] = left
            arrives = left + WARM_DELAY_S
        else:
            link = self.links[name, up]
            arrives = self.begins + link.carry(self.now - self.begins, len(data) + IP_HEADERS, self.losses)
        if math.isfinite(arrives):
            self.at(arrives - self.now, lambda: self._arrive(source, destination, data))


def drive(
    scenario: Scenario, mode: RedundancyMode, paths: Sequence[str] = PATHS, budget: Budget | None = None
) -> Driven:
    """Send the scenario's requests over these of its paths."""
    traffic = scenario.traffic
    mesh = DriveMesh(scenario)
    mesh.budgets = (budget,) if budget else ()
    service = rule(deadline_s=traffic.deadline_ms / 1e3, redundancy=mode, exploration=0.01)
    robot = mesh.robot(*paths, rules=(service,))
    for name in CLOUDS:
        _answer_one_at_a_time(mesh, mesh.cloud(name), traffic.compute_ms / 1e3, traffic.answer_bytes)
    mesh.push_views()
    mesh.run(STARTING_S)
    mapped(mesh, robot, *zip(paths, CLOUDS, strict=False))
    numbers = count(1)
    _call(mesh, robot, int(WARM_S * traffic.rate_hz), scenario, numbers)
    mesh.now = mesh.begins
    asked = _call(mesh, robot, scenario.count, scenario, numbers)
    sent = sum(mesh.links[name, True].sent for name in PATHS)
    mesh.run(2 * traffic.deadline_ms / 1e3)
    in_time = {event.request_id for event in robot.responses() if not event.late}
    copies = {"first": 0, "extra": 0}
    for (_, _, kind), size in robot.engine.stats.copy_bytes.items():
        copies[kind] += size
    return Driven(len(asked), len(asked - in_time), sent, copies["first"], copies["extra"])


def _answer_one_at_a_time(mesh: Mesh, cloud: Node, compute_s: float, size: int) -> None:
    free_at = mesh.now

    def delay() -> float:
        nonlocal free_at
        free_at = max(free_at, mesh.now) + compute_s
        return free_at - mesh.now

    cloud.server_delay = delay
    cloud.answer = lambda request: request[:16] + bytes(size)


def _call(mesh: Mesh, robot: Node, calls: int, scenario: Scenario, numbers: count[int]) -> set[bytes]:
    asked: set[bytes] = set()
    for _ in range(calls):
        asked.add(robot.submit(next(numbers).to_bytes(4, "big") + bytes(scenario.traffic.request_bytes)))
        mesh.run(1 / scenario.traffic.rate_hz)
    return asked


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--traces", type=Path, required=True, help="folder of recorded traces")
    parser.add_argument("--scenario", default="a-drive-*", metavar="GLOB")
    options = parser.parse_args()
    modes = [RedundancyMode.SINGLE, RedundancyMode.HEDGE, RedundancyMode.ADAPTIVE, RedundancyMode.REPLICATE]
    total = dict.fromkeys(("alone", *(mode.value for mode in modes)), (0, 0))
    for scenario in read_scenarios(read_folder(options.traces)):
        if not fnmatch.fnmatch(scenario.name, options.scenario):
            continue
        alone = min((drive(scenario, RedundancyMode.SINGLE, path) for path in PATHS), key=lambda of: of.misses)
        runs = {"alone": alone, **{mode.value: drive(scenario, mode) for mode in modes}}
        for name, run in runs.items():
            total[name] = (total[name][0] + run.misses, total[name][1] + run.sent)
        line = ", ".join(f"{name} {run.misses} missed {run.sent / 1e6:.1f} MB" for name, run in runs.items())
        sys.stdout.write(f"{scenario.name}: {line}\n")
        sys.stdout.flush()
    (alone_missed, _), (replicate_missed, _), (_, single_sent) = total["alone"], total["replicate"], total["single"]
    for name, (missed, sent) in total.items():
        avoided = (alone_missed - missed) / max(1, alone_missed - replicate_missed)
        sys.stdout.write(f"{name}: {missed} missed, {avoided:.1%} avoided, {sent / single_sent - 1:+.1%} bytes\n")


if __name__ == "__main__":
    main()
