"""`python -m bench alerts`: shows what a real Alertmanager says as parts of a fleet fail.

A server hangs, another server's ROS node dies, then a whole server, and then the control plane. The control plane and
its mutual TLS are real; the members are only control streams (`bench.control`).
"""

from __future__ import annotations

import asyncio
import random
import resource
import socket
import sys
import tempfile
import time
from pathlib import Path
from typing import TYPE_CHECKING

from bench.alerts.monitoring import Monitoring, MonitoringError, Ports
from bench.control.crowd import Crowd
from bench.control.member import SERVICE, Member
from bench.control.plane import Plane
from plr.controlplane.ca import Authority
from plr.protos.model.ids import InterfaceName, NodeName, Role
from plr.protos.trust.identity import IdentityRole

if TYPE_CHECKING:
    import argparse
    from collections.abc import Callable

LONGEST_FOR_S = 300.0
"""Longest wait of any rule before it fires."""
SHORT_S = 120.0
"""How long a ROS node may be away."""
PATIENCE_S = 300.0
LOOK_EVERY_S = 0.05


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of `python -m bench alerts`."""
    parser.add_argument("--robots", type=int, default=50, metavar="N", help="number of robots (default %(default)s)")
    parser.add_argument("--servers", type=int, default=5, metavar="N", help="servers, at least 4 (default %(default)s)")
    parser.add_argument("--interfaces", type=int, default=2, metavar="N", help="of each robot (default %(default)s)")
    parser.add_argument("--scrape-s", type=float, default=1.0, help="scrape interval (default %(default)s)")
    parser.add_argument(
        "--pace", type=float, default=10.0, help="divide the waits of the shipped alerts by this (default %(default)s)"
    )
    parser.add_argument("--series-only", action="store_true", help="count series and time scrapes, but stop nothing")
    parser.add_argument("--keep-logs", type=Path, metavar="DIR", help="keep configurations and logs here")


def run(options: argparse.Namespace) -> int:
    """Run it and return the exit code: 1 unless each death was notified once, and nothing else was."""
    most = resource.getrlimit(resource.RLIMIT_NOFILE)[1]
    resource.setrlimit(resource.RLIMIT_NOFILE, (most, most))
    with tempfile.TemporaryDirectory(prefix="plr-bench-") as temporary:
        folder = options.keep_logs or Path(temporary)
        folder.mkdir(parents=True, exist_ok=True)
        try:
            return asyncio.run(_Trial(options, folder.resolve()).run())
        except MonitoringError as error:
            sys.stderr.write(f"{error}\n")
            return 1


class _Trial:
    def __init__(self, options: argparse.Namespace, folder: Path) -> None:
        self._options = options
        authority = Authority.create()
        rng = random.Random(1)
        clouds = tuple(NodeName(f"cloud-{number}") for number in range(options.servers))
        nics = tuple(InterfaceName(f"wwan{number}") for number in range(options.interfaces))
        self._members = [
            Member(name, Role.CLOUD, authority.issue(name, IdentityRole.CLOUD), (), rng) for name in clouds
        ]
        for number in range(options.robots):
            name = NodeName(f"robot-{number:05}")
            issued = authority.issue(name, IdentityRole.ROBOT)
            self._members.append(Member(name, Role.ROBOT, issued, clouds, rng, interfaces=nics))
        control, metrics, *others = (_free_port() for _ in range(5))
        self._plane = Plane(folder, authority, (control, metrics))
        self._crowd = Crowd(self._members, self._plane.target, authority.ca_pem)
        self._heard_before = 0
        self._monitoring = Monitoring(folder, metrics, Ports(*others), scrape_s=options.scrape_s, pace=options.pace)

    async def run(self) -> int:
        """Go through all failures."""
        self._plane.start()
        try:
            await asyncio.sleep(5.0)
            self._crowd.start()
            await self._until("registrations", lambda: self._crowd.online() == len(self._members))
            await self._until("mappings", lambda: self._crowd.unmapped() == 0)
            await asyncio.to_thread(self._monitoring.start)
            await self._until_scraped()
            return await self._judge()
        finally:
            await self._crowd.close()
            self._plane.kill()
            self._monitoring.close()

    async def _until_scraped(self) -> None:
        give_up_at = time.monotonic() + PATIENCE_S
        while await asyncio.to_thread(self._monitoring.value, "count(plr_sidecar_up)") < len(self._members):
            if time.monotonic() > give_up_at:
                raise MonitoringError("nothing is scraped")
            await asyncio.sleep(1.0)

    async def _judge(self) -> int:
        # Members that are scraped or register late may raise alerts now.
        await asyncio.sleep(3.0 + 3.0 * self._options.scrape_s)
        await self._tell_series()
        if self._options.series_only:
            return 0
        self._heard_before = len(self._monitoring.notifications)
        dead, hung, bare = (member.name for member in self._members[:3])
        _say(f"the ROS node of {hung} hangs")
        self._crowd.hang_server(hung)
        well = await self._notified([f"PlrServerAnswersNobody{{server={hung}, service={SERVICE}}}"])
        _say(f"the ROS node of {bare} is restarted, and dies some seconds later")
        self._crowd.serve(bare, up=False)
        await asyncio.sleep(SHORT_S / self._options.pace)
        self._crowd.serve(bare, up=True)
        await asyncio.sleep(SHORT_S / self._options.pace)
        self._crowd.serve(bare, up=False)
        well &= await self._notified([f"PlrServerLostService{{server={bare}, service={SERVICE}}}"])
        _say(f"{dead} dies")
        await self._crowd.leave(dead)
        self._crowd.lose_server(dead)
        well &= await self._notified([f"PlrServerDown{{server={dead}}}"])
        _say("the control plane dies")
        self._plane.kill()
        down = [text for text in await self._heard() if not text.startswith("PlrControlPlaneDown")]
        if down:
            _say(f"NOT WANTED: {down}")
        return 0 if well and not down else 1

    async def _tell_series(self) -> None:
        ask = self._monitoring.value
        fleet = await asyncio.to_thread(ask, 'count({__name__=~"plr_(sidecar|robot|predicted|observed|target).*"})')
        job = await asyncio.to_thread(ask, 'scrape_samples_scraped{job="plr-controlplane"}')
        took = await asyncio.to_thread(ask, 'max_over_time(scrape_duration_seconds{job="plr-controlplane"}[5m])')
        head = await asyncio.to_thread(self._monitoring.series)
        _say(f"series of members: {fleet:.0f}; of a scrape: {job:.0f}; in Prometheus' head, with rules: {head}")
        _say(f"the longest scrape took {took:.2f} s; longest turn of the loop: {self._plane.hold()}")

    async def _notified(self, wanted: list[str]) -> bool:
        heard = await self._heard()
        if heard != wanted:
            _say(f"WANTED {wanted}")
        return heard == wanted

    async def _heard(self) -> list[str]:
        """Return the alerts notified since the last call, once the slowest rule would have fired."""
        await asyncio.sleep(LONGEST_FOR_S / self._options.pace + 10.0)
        pending = await asyncio.to_thread(self._monitoring.firing)
        told = self._monitoring.notifications[self._heard_before :]
        self._heard_before += len(told)
        for one in told:
            text = ", ".join(one.firing) or "resolved"
            _say(f"notification to {one.receiver}: {text} {' '.join(one.links)}".rstrip())
            if not all(link.startswith(f"{self._monitoring.pages}/operate/runbook.md#") for link in one.links):
                raise MonitoringError("a runbook_url leads nowhere")
        _say(f"{len(told)} notifications; alerts in Prometheus: {dict(pending)}")
        return [text for one in told for text in one.firing]

    async def _until(self, what: str, holds: Callable[[], bool]) -> None:
        give_up_at = time.monotonic() + PATIENCE_S
        while not holds():
            if time.monotonic() > give_up_at:
                raise MonitoringError(f"no {what} after {PATIENCE_S:g} s")
            await asyncio.sleep(LOOK_EVERY_S)


def _say(text: str) -> None:
    sys.stdout.write(f"{text}\n")
    sys.stdout.flush()


def _free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port: int = taken.getsockname()[1]
        return port
