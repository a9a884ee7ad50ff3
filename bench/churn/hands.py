"""Inflicts troubles on the lab, undoes them, and checks whether the disturbed resource works again."""

from __future__ import annotations

import signal
from typing import TYPE_CHECKING

from bench.churn.schedule import PATHS, SERVERS, Kind, Lane, Trouble
from bench.churn.workloads import SERVICES
from lab import Lab, LabConfig, LinkProfile
from lab.system import System

if TYPE_CHECKING:
    from pathlib import Path

PROFILES = {
    "wlan0": LinkProfile(delay_ms=5, jitter_ms=2, loss=0.002, rate_kbps=60_000),
    "wwan0": LinkProfile(delay_ms=15, jitter_ms=5, loss=0.002, rate_kbps=30_000),
}
BURST_LOSS = 0.4
FIRST_NEW_ADDRESS, NEW_ADDRESSES = 50, 100


class Hands:
    """The running system and what can be done to it."""

    def __init__(self, lab: Lab, folder: Path) -> None:
        self.system = System(lab, folder)
        self.complaints: list[str] = []
        """What programs did wrong when asked to end."""
        self._lab = lab
        self._readdressed = 0
        self._answers_before: dict[str, float] = {}

    @staticmethod
    def lab(seed: int) -> Lab:
        """Make the lab that the schedule's names refer to."""
        return Lab(LabConfig.of(interfaces=PATHS, clouds=len(SERVERS)), seed=seed)

    def start(self) -> None:
        """Bring everything up, and wait until the robot offers the services."""
        for interface, profile in PROFILES.items():
            self._lab.link(interface).set(profile)
        self.system.start_control_plane()
        for cloud in SERVERS:
            self._start_ros(cloud)
            self._start_sidecar(cloud)
        rules = [service.rule() for service in SERVICES]
        self.system.wait_for_offer(self.system.start_robot(rules, interfaces=PATHS), len(rules))

    def begin(self, trouble: Trouble) -> None:
        """Inflict a trouble."""
        target = trouble.target
        match trouble.kind:
            case Kind.BLACKHOLE:
                self._lab.link(target).blackhole()
            case Kind.UNPLUG:
                self._lab.link(target).unplug()
            case Kind.SWITCH_OFF:
                self._lab.host("robot").link_down(target)
            case Kind.LOSS_BURST:
                self._lab.link(target).change(loss=BURST_LOSS)
            case Kind.REBIND_NAT:
                self._lab.nat(target).rebind()
            case Kind.READDRESS:
                self._readdress(target)
            case Kind.KILL_ROS:
                self._kill_ros(target)
            case Kind.KILL_SIDECAR:
                self._kill(f"{target}.sidecar")
            case Kind.KILL_HOST:
                self._kill(f"{target}.sidecar")
                self._kill_ros(target)
            case Kind.STOP_SIDECAR:
                self.system.parts[f"{target}.sidecar"].process.send_signal(signal.SIGTERM)
            case Kind.KILL_CONTROL:
                self._kill("controlplane")

    def end(self, trouble: Trouble) -> None:
        """Undo a trouble; the resource still has to recover."""
        target = trouble.target
        match trouble.kind:
            case Kind.BLACKHOLE | Kind.UNPLUG:
                self._lab.link(target).restore()
            case Kind.SWITCH_OFF:
                self._lab.host("robot").link_up(target)
            case Kind.LOSS_BURST:
                self._lab.link(target).set(PROFILES[target])
            case Kind.KILL_ROS:
                self._start_ros(target)
            case Kind.KILL_SIDECAR:
                self._start_sidecar(target)
            case Kind.KILL_HOST:
                self._start_ros(target)
                self._start_sidecar(target)
            case Kind.STOP_SIDECAR:
                self._expect_good_end(f"{target}.sidecar")
                self._start_sidecar(target)
            case Kind.KILL_CONTROL:
                self.system.start_control_plane()
            case _:
                pass
        if trouble.lane is Lane.SERVERS:
            self._answers_before[target] = self._answers(target) if trouble.kind is Kind.KILL_ROS else 0.0

    def works(self, lane: Lane, target: str, well: frozenset[str]) -> bool:
        """Return whether a disturbed resource is in use again; `well` holds the others that are.

        A path is if it answers to every server that is well, a server if it has answered a request since its return,
        the control plane if the robot is connected.
        """
        match lane:
            case Lane.PATHS:
                robot = self.system.metrics("robot")
                peers = [cloud.replace("_", "-") for cloud in SERVERS if cloud in well]
                up = [robot.get(f'plr_path_up{{interface="{target}",peer="{peer}"}}') for peer in peers]
                return bool(up) and all(value == 1 for value in up)
            case Lane.SERVERS:
                return self._answers(target) > self._answers_before.get(target, 0.0)
            case Lane.CONTROL:
                return self.system.metrics("robot").get("plr_control_plane_connected") == 1

    def _answers(self, cloud: str) -> float:
        """Return how many requests the local servers have answered since their sidecar started."""
        return sum(
            value
            for series, value in self.system.metrics(cloud).items()
            if series.startswith("plr_bridge_messages_total") and 'direction="answer_from_server"' in series
        )

    def _readdress(self, interface: str) -> None:
        robot, router = self._lab.host("robot"), self._lab.nat(interface).router
        number = FIRST_NEW_ADDRESS + self._readdressed % NEW_ADDRESSES
        self._readdressed += 1
        route = f"dev {interface} metric {100 * (1 + PATHS.index(interface))}"
        gateways = {family: router.address("lan0", family) for family in (4, 6)}
        networks = {family: gateway[:-1] for family, gateway in gateways.items()}
        robot.ip_batch(
            [
                f"addr flush dev {interface} scope global",
                f"addr add {networks[4]}{number}/24 dev {interface}",
                f"addr add {networks[6]}{number:x}/64 dev {interface} nodad",
                *(f"route replace default via {gateway} {route}" for gateway in gateways.values()),
            ]
        )

    def _start_ros(self, cloud: str) -> None:
        for service in SERVICES:
            argv = ["-m", "lab.echo", "serve", "--name", service.part, "--service", service.name]
            argv += ["--delay-ms", str(service.takes_ms)]
            self.system.start_node(f"{cloud}.{service.part}", cloud, argv)

    def _kill_ros(self, cloud: str) -> None:
        for service in SERVICES:
            self._kill(f"{cloud}.{service.part}")

    def _start_sidecar(self, cloud: str) -> None:
        self.system.start_cloud(cloud, [{"name": service.name} for service in SERVICES])

    def _kill(self, name: str) -> None:
        self.system.parts[name].kill()

    def _expect_good_end(self, name: str) -> None:
        part = self.system.parts[name]
        code = part.process.poll()
        if code is None:
            part.kill()  # it was not given the time that a stop may take
        elif code != 0:
            self.complaints.append(f"{name} ended with {code} when it was stopped")
