"""A robot keeps its deadline while a carrier goes dark, a server is killed and the control plane is killed.

Everything is real: ROS 2 nodes, sidecars, control plane, in network namespaces with a NAT behind each of the robot's
two interfaces; only the radio is emulated. Beside the robot with both carriers, two more robots with one carrier each
do the same work at the same time over the same links: what one would have without PLR's second path.

examples:
  make demo
  make demo DEMO_ARGS='--seconds 30 --out /tmp/demo'
"""

from __future__ import annotations

import argparse
import contextlib
import re
import sys
import tempfile
import time
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from rich.console import Console

from lab import Lab, LabConfig, LabError
from lab.demo import report
from lab.demo.story import PHASES, WLAN, WWAN, Stage
from lab.pressure import BUSY_SHARE, CpuPressure
from lab.system import Part, System, SystemFailureError, read_json

if TYPE_CHECKING:
    from collections.abc import Iterator

DEADLINE_MS = 100.0
RATE_HZ = 10.0
ROBOTS = {"wlan0 alone": ("wlan0",), "wwan0 alone": ("wwan0",), "PLR, both": ("wlan0", "wwan0")}
"""Shown name -> interfaces; each robot has a ROS domain of its own on the same host."""
CLOUDS = ("cloud_a", "cloud_b")
_PROGRESS = re.compile(r"unanswered\s+(\d+).*late\s+(\d+).*median\s+([\d.]+|-)")

INTRODUCTION = f"""\
Three robots ask two cloud servers for a path, {RATE_HZ:g} times a second each, at the same time, over the same two
emulated carriers (wlan0, wwan0), each behind its own NAT. Two have one carrier; the third, PLR, has both and sends
every request over both, to different servers: the first answer wins. Each answer should come within {DEADLINE_MS:g} ms.
All of it is secured, with certificates made for this run.

Below: median latency of the last second, how many requests were late so far, and how many wait for an answer.
"""

console = Console(highlight=False, soft_wrap=True)


class DemoStage(Stage):
    """Carries out the phases on the system."""

    def __init__(self, lab: Lab, system: System) -> None:
        self._lab = lab
        self._system = system

    def start_all(self) -> None:
        self.start_control_plane()
        for cloud in CLOUDS:
            self._start_cloud(cloud)

    def blackhole(self, interface: str) -> None:
        self._lab.link(interface).blackhole()

    def restore(self, interface: str) -> None:
        self._lab.link(interface).restore()

    def kill_cloud(self) -> None:
        for part in ("cloud_b.server", "cloud_b.sidecar"):
            self._system.parts[part].kill()

    def start_cloud(self) -> None:
        self._start_cloud("cloud_b")

    def kill_control_plane(self) -> None:
        self._system.parts["controlplane"].kill()

    def start_control_plane(self) -> None:
        self._system.start_control_plane()

    def _start_cloud(self, cloud: str) -> None:
        self._system.start_node(f"{cloud}.server", cloud, ["-m", "examples.motion_planning.server"])
        self._system.start_cloud(cloud, [{"name": "/plan_path"}])


def main() -> int:
    """Run the command line; return 0 only if every request of the PLR robot was answered exactly once."""
    parser = argparse.ArgumentParser(
        prog="python -m lab.demo", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seconds", type=float, default=60.0, help="length of the run (default %(default)s)")
    parser.add_argument("--seed", type=int, default=1, help="seed of the links (default %(default)s)")
    parser.add_argument(
        "--out", type=Path, default=Path("bench/results"), help="folder for plot and JSON (default %(default)s)"
    )
    parser.add_argument("--keep-logs", type=Path, metavar="DIR", help="keep configurations and logs here")
    options = parser.parse_args()
    if not 10 <= options.seconds <= 3600:
        parser.error(f"--seconds: expected 10 to 3600, got {options.seconds:g}")
    try:
        with _folder(options.keep_logs) as folder:
            return run(folder, options)
    except (LabError, SystemFailureError) as error:
        print(f"demo: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        console.print("interrupted; nothing is left behind")
        return 130


@contextlib.contextmanager
def _folder(keep: Path | None) -> Iterator[Path]:
    if keep is not None:
        keep.mkdir(parents=True, exist_ok=True)
        yield keep.resolve()
        return
    with tempfile.TemporaryDirectory(prefix="plr-demo-") as name:
        yield Path(name)


def run(folder: Path, options: argparse.Namespace) -> int:
    """Bring the system up, play the story, report."""
    console.print(INTRODUCTION)
    with Lab(LabConfig.of(interfaces=("wlan0", "wwan0"), clouds=len(CLOUDS)), seed=options.seed) as lab:
        lab.link("wlan0").set(WLAN)
        lab.link("wwan0").set(WWAN)
        system = System(lab, folder)
        stage = DemoStage(lab, system)
        with console.status("starting the control plane and two cloud servers"):
            stage.start_all()
        with console.status("starting three robots; waiting until /plan_path is offered on each"):
            clients = _start_robots(system, options.seconds)
        pressure = CpuPressure()
        marks, zero = _play(stage, clients, options.seconds)
        waited = pressure.share()
        with console.status("waiting for the last answers"):
            for client in clients.values():
                client.process.wait(30)
        lateness = {name: lab.link(name).stats().lateness.p99_s * 1e3 for name in ("wlan0", "wwan0")}
        shares = _shares_of_wins(system)
        system.close()
    code = _report(folder, options, marks, zero, shares, lateness)
    if waited is not None and waited > BUSY_SHARE:
        console.print(
            f"[yellow]This machine was too busy to judge latencies: for {waited:.0%} of the run some program waited "
            "for a processor. The counts of lost and doubled answers hold all the same.[/yellow]"
        )
    return code


def _start_robots(system: System, seconds: float) -> dict[str, Part]:
    service = {"name": "/plan_path", "deadline_ms": DEADLINE_MS, "idempotent": True}
    sidecars = [
        system.start_robot(
            [service], name=_slug(name), interfaces=interfaces, domain=domain, metrics_port=9464 + domain
        )
        for domain, (name, interfaces) in enumerate(ROBOTS.items())
    ]
    for sidecar in sidecars:
        system.wait_for_offer(sidecar)
    clients = {}
    for domain, name in enumerate(ROBOTS):
        argv = ["-m", "examples.motion_planning.client", "--rate", str(RATE_HZ), "--duration", str(seconds)]
        argv += ["--deadline-ms", str(DEADLINE_MS), "--grace-s", "15"]
        argv += ["--seed", "1", "--json", str(system.folder / f"{_slug(name)}.json")]
        clients[name] = system.start_node(f"{_slug(name)}.client", "robot", argv, domain=domain)
    for client in clients.values():
        system.wait(f"{client.name} to call", partial(_has_called, client))
    return clients


def _has_called(client: Part) -> bool:
    return " sent " in client.log.read_text()


def _slug(name: str) -> str:
    return "robot-" + name.partition(" ")[0].strip(",").lower()


def _play(stage: Stage, clients: dict[str, Part], seconds: float) -> tuple[list[report.Mark], float]:
    """Run the phases; return when each began, and second 0 (monotonic)."""
    zero = time.monotonic()
    unit = seconds / sum(phase.weight for phase in PHASES)
    marks = []
    end = zero
    for phase in PHASES:
        marks.append(report.Mark(phase.name, time.monotonic() - zero, phase.shade))
        console.print(f"[bold]{time.monotonic() - zero:4.0f} s  {phase.name}[/bold]")
        phase.begin(stage)
        end += phase.weight * unit
        while time.monotonic() < end:
            time.sleep(min(2.5, max(0.0, end - time.monotonic())))
            console.print("        " + "  ".join(_progress(name, client) for name, client in clients.items()))
    return marks, zero


def _progress(name: str, client: Part) -> str:
    lines = _PROGRESS.findall(client.log.read_text(errors="replace"))
    unanswered, late, median = lines[-1] if lines else ("0", "0", "-")
    shown = "none" if median == "-" else f"{float(median):.0f} ms"
    colour = "red" if median == "-" or float(median) > DEADLINE_MS else "green"
    short = name.removesuffix(" alone").removesuffix(", both")
    return f"{short} [{colour}]{shown:>7}[/{colour}] late {late:>3} open {unanswered:>3}"


def _shares_of_wins(system: System) -> dict[str, float]:
    """Return the share of PLR's answers that came over each interface."""
    port = 9464 + list(ROBOTS).index("PLR, both")
    wins: dict[str, float] = {}
    for series, value in system.metrics("robot", port).items():
        if series.startswith("plr_path_wins_total"):
            interface = series.partition('interface="')[2].partition('"')[0]
            wins[interface] = wins.get(interface, 0.0) + value
    total = sum(wins.values()) or 1.0
    return {f"{interface} alone": count / total for interface, count in wins.items()}


def _report(
    folder: Path,
    options: argparse.Namespace,
    marks: list[report.Mark],
    zero: float,
    shares: dict[str, float],
    lateness: dict[str, float],
) -> int:
    runs = {name: read_json(folder / f"{_slug(name)}.json") for name in ROBOTS}
    contenders = [report.contender(name, run, shares.get(name)) for name, run in runs.items()]
    said = report.sentence(contenders, DEADLINE_MS)
    options.out.mkdir(parents=True, exist_ok=True)
    report.plot(options.out / "demo.png", runs, marks, zero, DEADLINE_MS)
    report.write_json(options.out / "demo.json", contenders, marks, lateness, said)
    console.print(report.table(contenders, DEADLINE_MS))
    console.print(said)
    console.print(f"plot: {options.out / 'demo.png'}   figures: {options.out / 'demo.json'}")
    plr = contenders[-1]
    return 0 if plr.lost == plr.answered_twice == plr.wrong == 0 and plr.sent else 1


if __name__ == "__main__":
    sys.exit(main())
