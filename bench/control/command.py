"""`python -m bench control`: measures fleets of 500 to 4,000 sidecars, one by one, each from first start to end."""

from __future__ import annotations

import asyncio
import dataclasses
import json
import random
import resource
import socket
import tempfile
import time
from pathlib import Path
from typing import TYPE_CHECKING

from rich.console import Console

from bench.control.crowd import Crowd
from bench.control.member import INTERFACES, SERVICE, Member
from bench.control.plane import Plane
from bench.control.targets import SIZES, targets
from bench.reporting.machine import machine
from bench.reporting.terminal import show_verdicts
from lab.pressure import CpuPressure
from plr.controlplane.ca import Authority
from plr.protos.model.ids import NodeName, Role
from plr.protos.trust.identity import IdentityRole

if TYPE_CHECKING:
    import argparse
    from collections.abc import Callable

SERVERS = 3
SETTLE_S = 20.0
"""Time from the registration of all to the steady state: the first mappings are solved and sent."""
READY_S = 12.0
"""Time from the start to the empty state: the solver's modules are loaded once nobody has come for some seconds."""
DEAD_S = 2.0
"""Minimum time from a kill to the next start."""
STATUS_LOOKS = 3
LEASES = 'plr_departures_total{reason="lease_expired"}'
LOOK_EVERY_S = 0.02
PATIENCE_S = 300.0


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of `python -m bench control`."""
    parser.add_argument(
        "--size", type=int, action="append", metavar="N", help=f"number of sidecars (repeatable; default {SIZES})"
    )
    parser.add_argument("--steady-s", type=float, default=30.0, help="seconds of steady load (default %(default)s)")
    parser.add_argument(
        "--out", type=Path, default=Path("bench/results"), help="folder for control.json (default %(default)s)"
    )
    parser.add_argument("--keep-logs", type=Path, metavar="DIR", help="keep configurations and logs here")


def run(options: argparse.Namespace) -> int:
    """Measure, write control.json and return the exit code: 1 if a target is missed."""
    console = Console(highlight=False, soft_wrap=True)
    most = resource.getrlimit(resource.RLIMIT_NOFILE)[1]
    resource.setrlimit(resource.RLIMIT_NOFILE, (most, most))
    sizes = tuple(options.size or SIZES)
    wanted = targets(sizes)
    figures = asyncio.run(_measure(sizes, options, console))
    show_verdicts(console, figures, wanted)
    console.print(f"figures: {options.out / 'control.json'}")
    return 1 if any(target.met(figures) is False for target in wanted) else 0


class Fleet:
    """One fleet of `size` sidecars with a control plane of its own."""

    def __init__(self, size: int, folder: Path, steady_s: float, say: Callable[[str], None]) -> None:
        self.figures: dict[str, float] = {}
        self.details: dict[str, object] = {}
        self._size = size
        self._steady_s = steady_s
        self._say = say
        authority = Authority.create()
        rng = random.Random(size)
        clouds = tuple(NodeName(f"cloud-{number}") for number in range(SERVERS))
        self._members = [
            Member(name, Role.CLOUD, authority.issue(name, IdentityRole.CLOUD), (), rng) for name in clouds
        ]
        for number in range(size - SERVERS):
            name = NodeName(f"robot-{number:05}")
            self._members.append(Member(name, Role.ROBOT, authority.issue(name, IdentityRole.ROBOT), clouds, rng))
        self._plane = Plane(folder, authority, (_free_port(), _free_port()))
        self._crowd = Crowd(self._members, self._plane.target, authority.ca_pem)

    async def measure(self) -> None:
        """Go through the fleet's life."""
        try:
            await self._measure()
        finally:
            await self._crowd.close()
            self._plane.kill()

    async def _measure(self) -> None:
        self._plane.start()
        await asyncio.sleep(READY_S)
        empty_kb = self._plane.resident_kb()
        self._crowd.start()
        began = time.monotonic()
        await self._until("everybody to be registered", lambda: self._crowd.online() == self._size)
        self._tell("first_s", time.monotonic() - began)
        await self._until("everybody to be mapped", lambda: self._crowd.unmapped() == 0)
        self._tell("first_mapped_s", time.monotonic() - began)

        await self._kill()
        self._crowd.ended.clear()
        began = self._plane.start()
        await self._until("everybody to be back", lambda: self._crowd.online() == self._size)
        self._figure("registered_s", time.monotonic() - began)
        self.details["streams ended"] = dict(self._crowd.ended)
        await asyncio.sleep(SETTLE_S)

        self._turns("restart")
        lost, spent, at = self._plane.metric(LEASES), self._plane.processor_s(), time.monotonic()
        pressure = CpuPressure()
        await asyncio.sleep(self._steady_s)
        self._figure("steady_core_share", (self._plane.processor_s() - spent) / (time.monotonic() - at))
        self.details["somebody waited for a processor"] = pressure.share()
        self._figure("leases_lost", self._plane.metric(LEASES) - lost)
        self._figure("kb_a_sidecar", (self._plane.resident_kb() - empty_kb) / self._size)
        steady = self._turns("steady")
        looks = [await asyncio.to_thread(self._plane.status_s) for _ in range(STATUS_LOOKS)]
        self._figure("status_s", sorted(looks)[STATUS_LOOKS // 2])

        await self._lose_a_server()
        self._figure("loop_hold_ms", 1000 * max(steady, self._turns("a server is lost")))

    async def measure_bare(self) -> None:
        """Go through the same with the anchor in place of the control plane."""
        clouds = [member.name for member in self._members if member.role is Role.CLOUD]
        what = (str(self._size), SERVICE, INTERFACES[0], *clouds)
        try:
            self._plane.start_bare(*what)
            self._crowd.start()
            await self._until("everybody to be registered", lambda: self._crowd.online() == self._size)
            await self._kill()
            began = self._plane.start_bare(*what)
            await self._until("everybody to be back", lambda: self._crowd.online() == self._size)
            self._figure("bare_registered_s", time.monotonic() - began)
            await self._until("everybody to be mapped", lambda: self._crowd.unmapped() == 0)
            await asyncio.sleep(DEAD_S)
            self._plane.lose_first_server()
            await self._remap(clouds[0], "bare_remapped_p99_s")
        finally:
            await self._crowd.close()
            self._plane.kill()

    async def _kill(self) -> None:
        """Kill the control plane, and wait until all members know: one process needs seconds for 4,000 broken streams,
        which 4,000 robots would not."""
        self._plane.kill()
        await asyncio.sleep(DEAD_S)
        await self._until("everybody to notice", lambda: self._crowd.online() == 0)

    async def _lose_a_server(self) -> None:
        dead = self._members[0].name
        await self._crowd.leave(dead)
        await self._remap(dead, "remapped_p99_s")

    async def _remap(self, dead: NodeName, key: str) -> None:
        users = [member for member in self._members if dead in member.mapped]
        at = self._crowd.lose_server(dead)
        await self._until("new mappings", lambda: not any(dead in member.mapped for member in users))
        taken = sorted(member.mapped_at - at for member in users)
        self.details[f"{key}: mapped to the dead server"] = len(users)
        self._figure(key, taken[int(0.99 * (len(taken) - 1))] if taken else 0.0)

    def _turns(self, phase: str) -> float:
        hold = self._plane.hold()
        self.details[f"longest turn, {phase}"] = dataclasses.asdict(hold)
        self._say(f"{self._size}: longest turn, {phase}: {hold}")
        return hold.cpu_s

    def _figure(self, key: str, value: float) -> None:
        self.figures[key] = value
        self._tell(key, value)

    def _tell(self, key: str, value: float) -> None:
        self.details[key] = value
        self._say(f"{self._size}: {key} {value:.3g}")

    async def _until(self, what: str, holds: Callable[[], bool]) -> None:
        give_up_at = time.monotonic() + PATIENCE_S
        say_at = time.monotonic() + 5.0
        while not holds():
            if time.monotonic() > give_up_at:
                raise TimeoutError(f"{self._size}: no {what} after {PATIENCE_S:g} s: {self._crowd.online()} are online")
            if time.monotonic() > say_at:
                say_at += 5.0
                self._say(f"{self._size}: waiting for {what}: {self._crowd.online()} online, {dict(self._crowd.ended)}")
            await asyncio.sleep(LOOK_EVERY_S)


async def _measure(sizes: tuple[int, ...], options: argparse.Namespace, console: Console) -> dict[str, float]:
    """Measure one size after the other, and write control.json. They share an event loop, as gRPC's threads need it."""
    wanted = targets(sizes)
    figures: dict[str, float] = {}
    details: dict[str, object] = {}
    pressure = CpuPressure()
    for size in sizes:
        with tempfile.TemporaryDirectory(prefix="plr-bench-") as temporary:
            folder = (options.keep_logs or Path(temporary)) / f"control-{size}"
            folder.mkdir(parents=True)
            fleet = Fleet(size, folder, options.steady_s, console.print)
            (folder / "bare").mkdir()
            anchor = Fleet(size, folder / "bare", options.steady_s, console.print)
            await fleet.measure()
            try:
                await anchor.measure_bare()
            except TimeoutError as error:
                anchor.details["bare"] = str(error)
                console.print(f"{size}: without gate and admission: {error}")
        measured = fleet.figures | anchor.figures
        figures.update({f"{key}_{size}": value for key, value in measured.items()})
        details[str(size)] = fleet.details | anchor.details
        found = {**figures, "verdicts": {target.key: target.met(figures) for target in wanted}}
        found |= {"details": details, "machine": {**machine(), "cpu_pressure": pressure.share()}}
        options.out.mkdir(parents=True, exist_ok=True)
        (options.out / "control.json").write_text(json.dumps(found, indent=1) + "\n")
    return figures


def _free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port: int = taken.getsockname()[1]
        return port
