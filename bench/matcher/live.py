"""Section `live`: two servers of the real system swap load, and the mapping follows.

The robot has one interface, so it uses one of two servers; the other is too busy for the deadline. Then that one is
idle, and the robot's own is busy. In between the sidecar saves the requests: at half the deadline it asks the other
one too.
"""

from __future__ import annotations

import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from bench.dataplane.section import Findings, Table
from bench.netlab import Lab, LabConfig, LinkProfile
from bench.system import System, read_json
from protos.errors import DecodeError
from protos.model import NodeName
from sidecar.state_file import decode_last_good
from sidecar.state_store import LAST_GOOD_FILE

if TYPE_CHECKING:
    from collections.abc import Callable

    from protos.explanation import Explanation

SERVICE = "/echo"
CLOUDS = ("cloud_a", "cloud_b")
DEADLINE_MS = 150
RATE_HZ = 20
BURDEN_MS = 250.0
LINKS = {"wlan0": LinkProfile(delay_ms=5, jitter_ms=2)}
BEFORE_S = 20.0
"""So long the other server is busy before they swap."""
FOLLOW_S = 60.0
"""The new mapping comes in this time, on a machine however busy."""
AFTER_S = 3.0
"""Requests that still go out once the mapping followed."""


@dataclass(frozen=True, slots=True)
class Followed:
    """What came of it."""

    seconds: float
    """From the swap to the new mapping at the robot's stream."""
    reason: str
    """Of the change, as `plr explain` tells it."""
    sent: int
    lost: int
    """Requests not answered, or wrongly, or twice."""
    late: int


def measure(say: Callable[[str], None]) -> Findings:
    """Swap the load once."""
    say("live: two servers swap load")
    with tempfile.TemporaryDirectory(prefix="plr-live-") as folder:
        followed = swap_load(Path(folder))
    findings = Findings(notes=[f"live: {followed.reason}"])
    findings.figures = {"live_follow_s": followed.seconds, "live_lost": followed.lost}
    row = (followed.seconds, followed.sent, followed.lost, followed.late)
    findings.tables = [Table("two servers swap load", ("followed after s", "sent", "lost", "late"), (row,))]
    return findings


def swap_load(folder: Path, *, before_s: float = BEFORE_S) -> Followed:
    """Bring the system up, swap the load of its two servers after so many seconds, wait until the mapping followed."""
    with Lab(LabConfig.of(interfaces=tuple(LINKS), clouds=len(CLOUDS)), seed=1) as lab:
        for name, profile in LINKS.items():
            lab.link(name).set(profile)
        system = System(lab, folder)
        try:
            return _swap(system, before_s)
        finally:
            system.close()


def _swap(system: System, before_s: float) -> Followed:
    _burden(system, busy="")
    system.start_control_plane()
    for cloud in CLOUDS:
        argv = ["-m", "bench.echo", "serve", "--burden", str(_burden_file(system, cloud))]
        system.start_node(f"{cloud}.server", cloud, argv)
        system.start_cloud(cloud, [{"name": SERVICE}])
    rule = {"name": SERVICE, "deadline_ms": DEADLINE_MS, "lifetime_ms": 30_000, "idempotent": True}
    system.wait_for_offer(system.start_robot([rule], interfaces=tuple(LINKS)))
    out = system.folder / "call.json"
    argv = ["-m", "bench.echo", "call", "--rate", str(RATE_HZ), "--duration", "600", "--grace-s", "25"]
    client = system.start_node("client", "robot", [*argv, "--deadline-ms", str(DEADLINE_MS), "--json", str(out)])
    system.wait("the mapping", lambda: bool(_mapped(system)))
    (own,) = _mapped(system)
    (other,) = (cloud for cloud in CLOUDS if _named(cloud) != own)
    _burden(system, busy=other)
    time.sleep(before_s)
    system.wait(f"the mapping to name {own}", lambda: _mapped(system) == {own})
    swapped = time.monotonic()
    _burden(system, busy=next(cloud for cloud in CLOUDS if cloud != other))
    system.wait(f"the mapping to name {other}", lambda: _mapped(system) == {_named(other)}, FOLLOW_S)
    explanation = system.explain("robot", SERVICE)
    seconds = time.monotonic() - (explanation.in_force_s or 0.0) - swapped
    time.sleep(AFTER_S)
    client.terminate()
    del system.parts[client.name]
    run = read_json(out)
    summary = run["summary"]
    # What it asked for in its last moments need not be answered: it was stopped.
    last = max(request["sent_s"] for request in run["requests"])
    open_then = [r for r in run["requests"] if r["latency_ms"] is None and r["sent_s"] < last - AFTER_S / 2]
    lost = len(open_then) + summary["answered_twice"] + summary["invalid"] + summary["strangers"]
    return Followed(seconds, _reason(explanation), summary["sent"], lost, summary["deadline_missed"])


def _named(cloud: str) -> str:
    return cloud.replace("_", "-")


def _burden_file(system: System, cloud: str) -> Path:
    return system.folder / f"{cloud}.burden"


def _burden(system: System, *, busy: str) -> None:
    for cloud in CLOUDS:
        new = system.folder / f"{cloud}.new"
        new.write_text(f"{BURDEN_MS if cloud == busy else 0.0}")
        new.replace(_burden_file(system, cloud))


def _mapped(system: System) -> set[str]:
    """The servers of the mapping that the robot holds."""
    try:
        last = decode_last_good((system.folder / "robot.state" / LAST_GOOD_FILE).read_bytes(), NodeName("robot"))
    except (OSError, DecodeError):
        return set()
    services = last.mapping.services if last.mapping is not None else ()
    return {assignment.server for mapping in services for assignment in mapping.assignments}


def _reason(explanation: Explanation) -> str:
    return explanation.mapping.reason if explanation.mapping is not None else ""
