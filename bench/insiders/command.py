"""`python -m bench insiders`."""

from __future__ import annotations

import re
import tempfile
import time
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from rich.console import Console

from bench.churn.machine import Machine, processor_s
from bench.churn.samples import Watch
from bench.insiders import report
from bench.insiders.report import Outcome, Phase
from bench.insiders.stage import HONEST, INSIDERS, WORKLOADS, Stage, make_lab
from lab.system import SystemFailureError, read_json

if TYPE_CHECKING:
    import argparse
    from collections.abc import Callable, Iterator

    from bench.insiders.stage import Workload
    from lab.system import Part

SAMPLE_EVERY_S = 5.0
SHOW_EVERY_S = 0.5
NON_TTY_EVERY = 20
"""Without a terminal, only one in this many lines of progress is shown."""
REST_S = 15.0
"""Time after the attack before the fleet counts as undisturbed again: sessions that the insiders left half open end."""
WARM_UP_S = 5.0
PAGE_WIDTH = 180
CYCLE_S = 30.0
"""Interval between restarts of an insider's program."""
_PROGRESS = re.compile(r"sent\s+(\d+)\s+unanswered\s+(\d+)")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of `python -m bench insiders`."""
    parser.add_argument("--minutes", type=float, default=10.0, help="length of the attack (default %(default)s)")
    parser.add_argument(
        "--quiet-minutes", type=float, default=2.0, help="undisturbed time before and after (default %(default)s each)"
    )
    parser.add_argument(
        "--only",
        action="append",
        metavar="PATTERN",
        help="run only attacks whose name matches (repeatable)",
    )
    parser.add_argument("--seed", type=int, default=1, help="seed of the links (default %(default)s)")
    parser.add_argument(
        "--out", type=Path, default=Path("bench/results"), help="folder for insiders.json (default %(default)s)"
    )
    parser.add_argument("--keep-logs", type=Path, metavar="DIR", help="keep configurations and logs here")


def run(options: argparse.Namespace) -> int:
    """Run, write insiders.json and return the exit code: 1 if a limit is missed."""
    console = Console(highlight=False, soft_wrap=True)
    if not console.is_terminal:
        console.width = PAGE_WIDTH
    with _folder(options.keep_logs) as folder:
        only = tuple(options.only or ("*",))
        attack_s, quiet_s = options.minutes * 60.0, options.quiet_minutes * 60.0
        outcome = insiders(console, folder, attack_s, quiet_s, only=only, seed=options.seed, apart=True)
    report.show(console, outcome)
    options.out.mkdir(parents=True, exist_ok=True)
    report.write_json(options.out / "insiders.json", outcome)
    console.print(f"figures: {options.out / 'insiders.json'}")
    return 1 if outcome.verdicts() else 0


def insiders(
    console: Console,
    folder: Path,
    attack_s: float,
    quiet_s: float,
    *,
    cycle_s: float = CYCLE_S,
    only: tuple[str, ...] = ("*",),
    seed: int = 1,
    apart: bool = False,
) -> Outcome:
    """Do one run in a lab of its own; with `apart` the insiders take no processor that an honest program wants."""
    with make_lab(seed) as lab:
        stage = Stage(lab, folder)
        try:
            with console.status("starting the control plane, three clouds and three robots"):
                stage.start()
                if apart:
                    stage.give_processors_to_the_honest()
            return _Run(console, stage, attack_s, quiet_s, cycle_s, only).outcome()
        finally:
            stage.close()


class _Run:
    def __init__(
        self, console: Console, stage: Stage, attack_s: float, quiet_s: float, cycle_s: float, only: tuple[str, ...]
    ) -> None:
        self._console = console
        self._stage = stage
        self._attack_s = attack_s
        self._quiet_s = quiet_s
        self._cycle_s = cycle_s
        self._only = only
        self._watch = Watch()
        self._machine = Machine()
        self._third_party_bytes = 0
        self._insiders_s: dict[str, float] = {}
        self._clients: list[Part] = []
        self._zero = 0.0
        self._sample_at = 0.0
        self._lines = 0
        self._load = ""

    def outcome(self) -> Outcome:
        """Go through the phases."""
        stage = self._stage
        length_s = WARM_UP_S + 2 * self._quiet_s + self._attack_s + REST_S
        self._clients = [stage.start_client(workload, length_s) for workload in WORKLOADS]
        for client in self._clients:
            self._wait_until_it_calls(client)
        self._zero = time.monotonic()
        with self._console.status("") as status:
            self._pass(WARM_UP_S, "warming up", status.update)
            before = self._phase(self._quiet_s, "undisturbed", status.update)
            counted, spent = stage.counters(), self._spent()
            stage.attack(self._cycle_s, self._only)
            attacked = self._phase(self._attack_s, "attacked", status.update)
            stage.leave_alone()
            counters, spent_later = stage.counters(), self._spent()
            self._pass(REST_S, "left alone", status.update)
            after = self._phase(self._quiet_s, "undisturbed again", status.update)
        self._insiders_s = {name: spent_later.get(name, 0.0) - spent.get(name, 0.0) for name in INSIDERS}
        with self._console.status("waiting for the last answers"):
            records = {workload: self._result(workload) for workload in WORKLOADS}
        return Outcome(
            before=before,
            attacked=attacked,
            after=after,
            records=records,
            tallies=stage.tallies(),
            counted={name: value - counted.get(name, 0.0) for name, value in counters.items()},
            third_party_bytes=self._third_party_bytes,
            insiders_s=self._insiders_s,
            lives=self._watch.lives,
            zero_s=self._zero,
            loads=self._machine.loads,
            failures=self._dead_or_cursing(),
        )

    def _phase(self, length_s: float, title: str, show: Callable[[str], None]) -> Phase:
        began = time.monotonic()
        self._pass(length_s, title, show)
        return Phase(began, time.monotonic())

    def _pass(self, length_s: float, title: str, show: Callable[[str], None]) -> None:
        end = time.monotonic() + length_s
        while (left := end - time.monotonic()) > 0:
            self._third_party_bytes += self._stage.bytes_to_third_party()
            if time.monotonic() >= self._sample_at:
                self._sample_at = time.monotonic() + SAMPLE_EVERY_S
                now = time.monotonic() - self._zero
                self._watch.take(now, {name: self._stage.system.parts[name] for name in HONEST})
                self._load = str(self._machine.look(now))
            line = f"{title}, {left:4.0f} s left   {self._progress()}"
            if self._console.is_terminal:
                show(line)
            elif self._lines % NON_TTY_EVERY == 0:
                self._console.print(line)
            self._lines += 1
            time.sleep(min(SHOW_EVERY_S, left))

    def _progress(self) -> str:
        counts = []
        for client in self._clients:
            found = _PROGRESS.findall(client.tail(3))
            sent, unanswered = found[-1] if found else ("0", "0")
            counts.append(f"{client.name}: {sent} sent, {unanswered} open")
        return "   ".join((*counts, self._load))

    def _spent(self) -> dict[str, float]:
        """Return the processor time of the insiders."""
        parts = self._stage.system.parts
        pids = {name: parts[name].process.inner_pid for name in INSIDERS}
        return {name: 0.0 if pid is None else processor_s(pid) for name, pid in pids.items()}

    def _wait_until_it_calls(self, client: Part) -> None:
        self._stage.system.wait(f"{client.name} to call", lambda: " sent " in client.log.read_text())

    def _result(self, workload: Workload) -> report.Records:
        part = self._stage.system.parts[workload.part]
        part.process.wait(120.0)
        file = self._stage.result_file(workload)
        if not file.exists():
            raise SystemFailureError(f"the client left no result\n{part.tail()}")
        return report.Records.of(read_json(file))

    def _dead_or_cursing(self) -> list[str]:
        parts = self._stage.system.parts
        found = [
            f"{name} ended with {parts[name].process.returncode}"
            for name in (*HONEST, *INSIDERS)
            if parts[name].process.poll() is not None
        ]
        for name in HONEST:
            found += report.flaws_of_log(name, parts[name].log.read_bytes())
        return found


@contextmanager
def _folder(keep: Path | None) -> Iterator[Path]:
    if keep is not None:
        keep.mkdir(parents=True, exist_ok=True)
        yield keep.resolve()
        return
    with tempfile.TemporaryDirectory(prefix="plr-insiders-") as name:
        yield Path(name)
