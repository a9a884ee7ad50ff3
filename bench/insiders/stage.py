"""Sets up the participants: honest robots and clouds, the insiders, a third party that belongs to no fleet.

robot, robot_2   wlan0, wwan0 behind NAT ──┐                ┌── cloud_a, cloud_b
                                           ├── internet ────┼── rogue_cloud
control ───────────────────────────────────┘                ├── rogue_robot (a public address: it can spoof)
                                                            └── third
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from lab import Lab, LabConfig, LinkProfile, robot, server
from lab.attacker.orders import ORDERS, TALLY, Orders
from lab.attacker.wire import Tap
from lab.system import CONTROL_METRICS_PORT, CONTROL_PORT, METRICS_PORT, System, read_json
from plr.protos.trust.identity import IdentityRole

if TYPE_CHECKING:
    from lab import HostSpec
    from lab.system import Part


def name_of(host: str) -> str:
    """Return a node's name as in its certificate."""
    return host.replace("_", "-")


ROBOTS = ("robot", "robot_2")
CLOUDS = ("cloud_a", "cloud_b")
ROGUE_ROBOT, ROGUE_CLOUD, THIRD = "rogue_robot", "rogue_cloud", "third"
STREAMS = "rogue_streams"
HONEST = (*(f"{name}.sidecar" for name in (*ROBOTS, *CLOUDS)), "controlplane")
INSIDERS = (f"{ROGUE_ROBOT}.sidecar", f"{ROGUE_CLOUD}.sidecar", STREAMS, f"{ROGUE_CLOUD}.echo")
PROFILES = {name: LinkProfile(delay_ms=10, jitter_ms=3) for name in ("wlan0", "wwan0")}
"""Both carriers are alike: where the rogue cloud is slow, a request's other copy answers over the other carrier. A
worse carrier must not add to that cost."""
SERVICE = {"name": "/echo", "deadline_ms": 500, "lifetime_ms": 30_000, "idempotent": True}
POLICY = {
    "calls": [
        {"robots": [name_of(name) for name in ROBOTS], "services": "/echo", "clouds": "*"},
        {"robots": name_of(ROGUE_ROBOT), "services": "/echo", "clouds": [name_of(name) for name in CLOUDS]},
    ],
    "offers": [{"clouds": "*", "services": "/echo"}],
}
"""The rogue cloud may offer what the honest ones offer. The rogue robot may call the service, but only at the honest
clouds, so that it does not waste itself on the rogue one."""


@dataclass(frozen=True, slots=True)
class Workload:
    """One honest robot's client."""

    robot: str
    size: int
    rate_hz: float

    @property
    def title(self) -> str:
        """Title for people."""
        return f"{name_of(self.robot)}, {self.size // 1000} kB at {self.rate_hz:g} Hz"

    @property
    def part(self) -> str:
        """The name of its process."""
        return f"{self.robot}.client-{self.size}"


WORKLOADS = tuple(Workload(name, size, rate) for name in ROBOTS for size, rate in ((1_000, 20.0), (100_000, 2.0)))


def make_lab(seed: int) -> Lab:
    """Make the lab; the rogue robot is among the clouds, since it has a public address."""
    clouds: tuple[HostSpec, ...] = tuple(server(name) for name in (*CLOUDS, ROGUE_CLOUD, ROGUE_ROBOT, THIRD))
    return Lab(LabConfig(robots=tuple(robot(name) for name in ROBOTS), clouds=clouds), seed=seed)


def yield_processors(part: Part) -> None:
    """Let a program's present and future threads run only on idle processors (SCHED_IDLE, sched(7)).

    An insider attacks from a machine of its own. Here it shares two processors with its victims, and its threads would
    take processor time from them that no packet of its could take.
    """
    pid = part.process.inner_pid
    assert pid is not None, part.name
    for thread in Path(f"/proc/{pid}/task").iterdir():
        os.sched_setscheduler(int(thread.name), os.SCHED_IDLE, os.sched_param(0))


class Stage:
    """The running system."""

    def __init__(self, lab: Lab, folder: Path) -> None:
        self.system = System(lab, folder)
        self._lab = lab
        third = lab.host(THIRD)
        self._third_party = (third.address(), third.address(family=6))
        rogues = (lab.host(name) for name in (ROGUE_ROBOT, ROGUE_CLOUD))
        self._insiders = {host.address(family=family) for host in rogues for family in (4, 6)}
        self._tap = Tap(third, third.interfaces[0])

    def start(self) -> None:
        """Bring everything up, with all programs honest."""
        for name in ROBOTS:
            for interface, profile in PROFILES.items():
                self._lab.link(interface, host=name).set(profile)
        self.system.start_control_plane(policy=POLICY)
        for name in (*CLOUDS, ROGUE_CLOUD):
            self.system.start_node(f"{name}.echo", name, ["-m", "lab.echo", "serve"])
        for name in CLOUDS:
            self.system.start_cloud(name, [{"name": "/echo"}])
        self.system.start_cloud(ROGUE_CLOUD, [{"name": "/echo"}], module="lab.attacker.insider")
        rogue = self.system.start_robot(
            [SERVICE],
            name=name_of(ROGUE_ROBOT),
            host=ROGUE_ROBOT,
            interfaces=["eth0"],
            module="lab.attacker.insider",
        )
        # Parts are named after their hosts.
        self.system.parts[f"{ROGUE_ROBOT}.sidecar"] = self.system.parts.pop(rogue.name)
        started = {name: self._start_robot(name) for name in ROBOTS}
        for part in started.values():
            self.system.wait_for_offer(part)
        self.system.wait("every path to be up", self._all_up)
        self._start_streams()

    def give_processors_to_the_honest(self) -> None:
        """Leave the insiders only idle processor time: apart from the network, nothing is shared then."""
        for name in INSIDERS:
            yield_processors(self.system.parts[name])

    def _start_robot(self, name: str) -> Part:
        part = self.system.start_robot([SERVICE], name=name_of(name), host=name)
        self.system.parts[f"{name}.sidecar"] = self.system.parts.pop(part.name)
        return part

    def _all_up(self) -> bool:
        peers = {name_of(name) for name in (*CLOUDS, ROGUE_CLOUD)}
        for name in ROBOTS:
            metrics = self.system.metrics(name)
            up = [metrics.get(f'plr_path_up{{interface="{one}",peer="{peer}"}}') for one in PROFILES for peer in peers]
            if not all(value == 1 for value in up):
                return False
        return True

    def _start_streams(self) -> None:
        target = f"{self._lab.host('control').address()}:{CONTROL_PORT}"
        who = [(ROGUE_ROBOT, IdentityRole.ROBOT), (ROGUE_CLOUD, IdentityRole.CLOUD)]
        certificates = [
            f"{self.system.tls_dir(name_of(name), role)}={name_of(name)}={role.value}" for name, role in who
        ]
        argv = ["-m", "lab.attacker.insider_streams", target, str(self._file(STREAMS, ".yaml")), *certificates]
        self.system.start_node(STREAMS, ROGUE_ROBOT, argv)

    def start_client(self, workload: Workload, length_s: float) -> Part:
        """Let an honest robot call for this long."""
        argv = ["-m", "lab.echo", "call", "--size", str(workload.size), "--rate", str(workload.rate_hz)]
        argv += ["--duration", str(length_s), "--deadline-ms", str(SERVICE["deadline_ms"]), "--queue-depth", "200"]
        argv += ["--grace-s", "40", "--json", str(self.result_file(workload))]
        return self.system.start_node(workload.part, workload.robot, argv)

    def result_file(self, workload: Workload) -> Path:
        """Return the file in which a client leaves its records."""
        return self.system.folder / f"{workload.part}.json"

    # -- the attack -----------------------------------------------------------------------------------------------

    def attack(self, cycle_s: float, only: tuple[str, ...]) -> None:
        """Let the insiders begin their attacks."""
        orders = Orders(cycle_s, self._third_party, tuple(name_of(name) for name in (*ROBOTS, *CLOUDS)), only)
        for name in self._orders_files():
            orders.write(self._file(name, ORDERS))

    def leave_alone(self) -> None:
        """Make the insiders honest again."""
        for name in self._orders_files():
            self._file(name, ORDERS).unlink(missing_ok=True)

    def tallies(self) -> dict[str, dict[str, list[int]]]:
        """Return runs, messages and bytes by insider and attack."""
        files = {name: self._file(name, TALLY) for name in self._orders_files()}
        return {name: read_json(file) for name, file in files.items() if file.exists()}

    def bytes_to_third_party(self) -> int:
        """Return the UDP payload that reached the third party from honest nodes since the last call."""
        return sum(
            len(one.payload) for one in self._tap.take() if not one.outgoing and one.source[0] not in self._insiders
        )

    def _orders_files(self) -> tuple[str, ...]:
        # The names that `System` gives the configurations.
        return f"{name_of(ROGUE_ROBOT)}.sidecar", f"{ROGUE_CLOUD}.sidecar", STREAMS

    def _file(self, name: str, suffix: str) -> Path:
        return self.system.folder / f"{name}{suffix}"

    # -- what the honest count ------------------------------------------------------------------------------------

    def counters(self) -> dict[str, float]:
        """Return every counter of the honest programs, by `host/series`."""
        found = {}
        for host in (*ROBOTS, *CLOUDS, "control"):
            port = CONTROL_METRICS_PORT if host == "control" else METRICS_PORT
            for series, value in self.system.metrics(host, port).items():
                found[f"{host}/{series}"] = value
        return found

    def close(self) -> None:
        """End everything."""
        self._tap.__exit__(None, None, None)
        self.system.close()
