"""Section `live`: two servers of the real system swap load, and the mapping follows.

There is one server more than the robot has interfaces, and the one that it does not use is too busy for the deadline.
Then that one becomes idle, and one of the robot's own busy. In between the sidecar saves the requests: another copy is
in time or, if there is none, it asks another server at half the deadline.
"""

from __future__ import annotations

import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from bench.dataplane.section import Findings
from bench.reporting.tables import Figure, Table
from lab import Lab, LabConfig, LinkProfile
from lab.system import System, read_json
from plr.protos.base.errors import DecodeError
from plr.protos.model.ids import NodeName
from plr.sidecar.state.file import decode_last_good
from plr.sidecar.state.store import LAST_GOOD_FILE

if TYPE_CHECKING:
    from collections.abc import Callable

    from plr.protos.model.explanation import Explanation

SERVICE = "/echo"
CLOUDS = ("cloud_a", "cloud_b", "cloud_c")
DEADLINE_MS = 150
RATE_HZ = 20
BURDEN_MS = 250.0
LINKS = {"wlan0": LinkProfile(delay_ms=5, jitter_ms=2), "wwan0": LinkProfile(delay_ms=15, jitter_ms=5)}
INTERFACES = (1, 2)
"""Numbers of interfaces, tried in turn, each with one server more."""
BEFORE_S = 20.0
"""How long the other server is busy before they swap."""
FOLLOW_S = 60.0
"""Time within which the new mapping comes, however busy the machine."""
AFTER_S = 3.0
"""How long requests still go out once the mapping has followed."""


@dataclass(frozen=True, slots=True)
class Followed:
    """The result of a swap."""

    seconds: float
    """Time from the swap to the new mapping at the robot's stream."""
    reason: str
    """Reason of the change, as shown by `plr explain`."""
    sent: int
    lost: int
    """Requests answered not at all, wrongly or twice."""
    late: int


def measure(say: Callable[[str], None]) -> Findings:
    """Swap the load once with each number of interfaces."""
    rows: list[tuple[str | Figure, ...]] = []
    findings = Findings()
    found: list[Followed] = []
    for interfaces in INTERFACES:
        say(f"live: two servers of {interfaces + 1} swap load")
        with tempfile.TemporaryDirectory(prefix="plr-live-") as folder:
            followed = swap_load(Path(folder), interfaces=interfaces)
        findings.notes.append(f"live: {followed.reason}")
        rows.append((f"{interfaces} x {interfaces + 1}", followed.seconds, followed.sent, followed.lost, followed.late))
        found.append(followed)
    two_servers, three_servers = found
    findings.figures = {
        "live_follow_s": two_servers.seconds,
        "live_2x3_follow_s": three_servers.seconds,
        "live_lost": sum(followed.lost for followed in found),
    }
    columns = ("interfaces x servers", "followed after s", "sent", "lost", "late")
    findings.tables = [Table("two servers swap load", columns, tuple(rows))]
    return findings


def swap_load(folder: Path, *, interfaces: int, before_s: float = BEFORE_S) -> Followed:
    """Bring the system up, swap the load of two servers after `before_s`, and wait until the mapping has followed."""
    links, clouds = dict(list(LINKS.items())[:interfaces]), CLOUDS[: interfaces + 1]
    with Lab(LabConfig.of(interfaces=tuple(links), clouds=len(clouds)), seed=1) as lab:
        for name, profile in links.items():
            lab.link(name).set(profile)
        system = System(lab, folder)
        try:
            return _swap(system, tuple(links), clouds, before_s)
        finally:
            system.close()


def _swap(system: System, links: tuple[str, ...], clouds: tuple[str, ...], before_s: float) -> Followed:
    _burden(system, clouds, busy="")
    system.start_control_plane()
    for cloud in clouds:
        argv = ["-m", "lab.echo", "serve", "--burden", str(_burden_file(system, cloud))]
        system.start_node(f"{cloud}.server", cloud, argv)
        system.start_cloud(cloud, [{"name": SERVICE}])
    rule = {"name": SERVICE, "deadline_ms": DEADLINE_MS, "lifetime_ms": 30_000, "idempotent": True}
    system.wait_for_offer(system.start_robot([rule], interfaces=links))
    out = system.folder / "call.json"
    argv = ["-m", "lab.echo", "call", "--rate", str(RATE_HZ), "--duration", "600", "--grace-s", "25"]
    client = system.start_node("client", "robot", [*argv, "--deadline-ms", str(DEADLINE_MS), "--json", str(out)])
    system.wait("the mapping", lambda: len(_mapped(system)) == len(links))
    (idle,) = (cloud for cloud in clouds if _named(cloud) not in _mapped(system))
    _burden(system, clouds, busy=idle)
    time.sleep(before_s)
    system.wait(f"the mapping to avoid {idle}", lambda: _avoids(system, idle, links), FOLLOW_S)
    own = next(cloud for cloud in clouds if cloud != idle)
    swapped = time.monotonic()
    _burden(system, clouds, busy=own)
    system.wait(f"the mapping to avoid {own}", lambda: _avoids(system, own, links), FOLLOW_S)
    explanation = system.explain("robot", SERVICE)
    seconds = time.monotonic() - (explanation.in_force_s or 0.0) - swapped
    time.sleep(AFTER_S)
    client.terminate()
    del system.parts[client.name]
    run = read_json(out)
    summary = run["summary"]
    # Requests of its last moments need not be answered: the client was stopped.
    last = max(request["sent_s"] for request in run["requests"])
    open_then = [r for r in run["requests"] if r["latency_ms"] is None and r["sent_s"] < last - AFTER_S / 2]
    lost = len(open_then) + summary["answered_twice"] + summary["invalid"] + summary["strangers"]
    return Followed(seconds, _reason(explanation), summary["sent"], lost, summary["deadline_missed"])


def _named(cloud: str) -> str:
    return cloud.replace("_", "-")


def _burden_file(system: System, cloud: str) -> Path:
    return system.folder / f"{cloud}.burden"


def _avoids(system: System, cloud: str, links: tuple[str, ...]) -> bool:
    mapped = _mapped(system)
    return _named(cloud) not in mapped and len(mapped) == len(links)


def _burden(system: System, clouds: tuple[str, ...], *, busy: str) -> None:
    for cloud in clouds:
        new = system.folder / f"{cloud}.new"
        new.write_text(f"{BURDEN_MS if cloud == busy else 0.0}")
        new.replace(_burden_file(system, cloud))


def _mapped(system: System) -> set[str]:
    """Return the servers of the mapping that the robot holds."""
    try:
        last = decode_last_good((system.folder / "robot.state" / LAST_GOOD_FILE).read_bytes(), NodeName("robot"))
    except (OSError, DecodeError):
        return set()
    services = last.mapping.services if last.mapping is not None else ()
    return {assignment.server for mapping in services for assignment in mapping.assignments}


def _reason(explanation: Explanation) -> str:
    return explanation.mapping.reason if explanation.mapping is not None else ""
