"""`python -m bench churn`."""

from __future__ import annotations

import tempfile
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console

from bench.churn import report
from bench.churn.hands import Hands
from bench.churn.runner import SAMPLE_EVERY_S, Runner
from bench.churn.schedule import SERVERS, make_schedule
from bench.churn.workloads import WORKLOADS
from lab.system import SystemFailureError, read_json

if TYPE_CHECKING:
    import argparse
    from collections.abc import Iterator

    from bench.churn.workloads import Workload
    from lab.system import Part

OURS = ("robot.sidecar", *(f"{cloud}.sidecar" for cloud in SERVERS), "controlplane")
BAD_LINES = ("Traceback", "internal error")
NON_TTY_EVERY = 20
"""Without a terminal, only one in this many lines of progress is shown."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of `python -m bench churn`."""
    parser.add_argument("--minutes", type=float, default=10.0, help="length of the run (default %(default)s)")
    parser.add_argument("--seed", type=int, default=1, help="seed of troubles and links (default %(default)s)")
    parser.add_argument(
        "--out", type=Path, default=Path("bench/results"), help="folder for churn.json (default %(default)s)"
    )
    parser.add_argument("--keep-logs", type=Path, metavar="DIR", help="keep configurations and logs here")


def run(options: argparse.Namespace) -> int:
    """Run, write churn.json and return the exit code: 1 if a request was lost or doubled, or a process grows."""
    console = Console(highlight=False, soft_wrap=True)
    with _folder(options.keep_logs) as folder:
        outcome = churn(console, folder, options.minutes * 60.0, options.seed)
    report.show(console, outcome)
    options.out.mkdir(parents=True, exist_ok=True)
    report.write_json(options.out / "churn.json", outcome)
    console.print(f"figures: {options.out / 'churn.json'}")
    return 1 if outcome.verdicts() else 0


def churn(console: Console, folder: Path, length_s: float, seed: int) -> report.Outcome:
    """Do one run in a lab of its own."""
    schedule = make_schedule(seed, length_s)
    console.print(f"{len(schedule)} troubles in {length_s:.0f} s, seed {seed}:")
    for trouble in schedule:
        console.print(f"  {trouble.begins_s:6.1f} s  {trouble}")
    with Hands.lab(seed) as lab:
        hands = Hands(lab, folder)
        with console.status("starting the control plane, two clouds and the robot"):
            hands.start()
        clients = {workload: _start_client(hands, workload, length_s) for workload in WORKLOADS}
        for client in clients.values():
            _wait_until_it_calls(hands, client)
        runner = Runner(hands, schedule, length_s, console.print)
        _play(console, runner, list(clients.values()))
        with console.status("waiting for the last answers"):
            summaries = {workload.title: _result(hands, workload, client) for workload, client in clients.items()}
        failures = runner.failures + hands.complaints + _dead_or_cursing(hands)
        hands.system.close()
    return report.Outcome(
        seed,
        length_s,
        summaries,
        runner.done,
        runner.postponed_s,
        runner.watch.lives,
        runner.watch.growths(length_s, SAMPLE_EVERY_S),
        runner.machine.loads,
        failures,
    )


def _play(console: Console, runner: Runner, clients: list[Part]) -> None:
    with console.status("") as status:
        lines = 0

        def show(line: str) -> None:
            nonlocal lines
            if console.is_terminal:
                status.update(line)
            elif lines % NON_TTY_EVERY == 0:
                console.print(f"          {line}")
            lines += 1

        runner.run(clients, list(OURS), show)


def _wait_until_it_calls(hands: Hands, client: Part) -> None:
    hands.system.wait(f"{client.name} to call", lambda: " sent " in client.log.read_text())


def _start_client(hands: Hands, workload: Workload, length_s: float) -> Part:
    argv = [*workload.argv(length_s), "--json", str(_result_path(hands, workload))]
    return hands.system.start_node(workload.part, "robot", argv)


def _result_path(hands: Hands, workload: Workload) -> Path:
    return hands.system.folder / f"{workload.part}.json"


def _result(hands: Hands, workload: Workload, client: Part) -> dict[str, Any]:
    client.process.wait(workload.grace_s + 60.0)
    path = _result_path(hands, workload)
    if not path.exists():
        raise SystemFailureError(f"the client left no result\n{client.tail()}")
    summary: dict[str, Any] = read_json(path)["summary"]
    return summary


def _dead_or_cursing(hands: Hands) -> list[str]:
    """Return programs that ended by themselves, and logs that contain what a program should not write."""
    found = [
        f"{name} ended with {hands.system.parts[name].process.returncode}"
        for name in OURS
        if hands.system.parts[name].process.poll() is not None
    ]
    for name in OURS:
        lines = hands.system.parts[name].log.read_text(errors="replace").splitlines()
        found += [f"{name}: {line}" for line in lines if any(bad in line for bad in BAD_LINES)]
    return found


@contextmanager
def _folder(keep: Path | None) -> Iterator[Path]:
    if keep is not None:
        keep.mkdir(parents=True, exist_ok=True)
        yield keep.resolve()
        return
    with tempfile.TemporaryDirectory(prefix="plr-churn-") as name:
        yield Path(name)
