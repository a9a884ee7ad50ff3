"""`python -m lab`: opens a lab to look around in."""

from __future__ import annotations

import argparse
import os
import select
import signal
import sys
import time
from typing import TYPE_CHECKING

from lab import commands
from lab.calibrate import calibrate
from lab.commands import apply_command, parse_command
from lab.errors import LabConfigError, LabError
from lab.lab import Lab
from lab.topology import LabConfig
from lab.traces import load_trace

if TYPE_CHECKING:
    from collections.abc import Sequence

    from lab.link import LinkStats

_EXAMPLES = """\
examples:
  python -m lab --link wlan0:delay_ms=20,loss=0.01 --link wwan0.down:rate_kbps=8000
      draws the lab, shows what its links do, and takes commands (`wlan0 blackhole`; `help` lists them)
  python -m lab shell robot
  python -m lab exec robot -- ping -c3 -I wwan0 cloud_a
  python -m lab --trace drive.csv.gz --paths wlan0=a,wwan0=b
  python -m lab calibrate
"""


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command and return the exit code: 0 ok, 1 the lab failed, 2 bad usage; for `exec` the program's."""
    arguments = _parser().parse_args(argv)
    try:
        config = LabConfig.of(
            interfaces=tuple(arguments.interfaces.split(",")),
            clouds=arguments.clouds,
            robots=arguments.robots,
        )
        first_commands = [parse_command(text) for text in arguments.link]
        if arguments.action == "exec":
            arguments.command = [word for place, word in enumerate(arguments.command) if place or word != "--"]
            if not arguments.command:
                raise LabConfigError("exec: expected a command after --")
        trace = load_trace(arguments.trace) if arguments.trace else None
        paths = _parse_paths(arguments.paths)
        with Lab(config, seed=arguments.seed) as lab:
            for command in first_commands:
                apply_command(lab, command)
            if trace is not None:
                lab.replay(trace, paths, repeat=arguments.repeat)
            return _run(lab, arguments)
    except LabConfigError as error:
        print(f"lab: {error}", file=sys.stderr)
        return 2
    except LabError as error:
        print(f"lab: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        return 130


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m lab",
        description="A network laboratory made of namespaces: robot, NAT routers, emulated links, clouds.",
        epilog=_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        "--interfaces", default="wlan0,wwan0", metavar="A,B", help="interfaces of the robot (%(default)s)"
    )
    parser.add_argument("--clouds", type=int, default=2, metavar="N", help="number of cloud hosts (%(default)s)")
    parser.add_argument("--robots", type=int, default=1, metavar="N", help="number of robots (%(default)s)")
    parser.add_argument("--seed", type=int, default=1, metavar="N", help="seed of loss and jitter (%(default)s)")
    parser.add_argument(
        "--link", action="append", default=[], metavar="IF:K=V,..", help="initial state of a link; repeatable"
    )
    parser.add_argument("--trace", metavar="FILE", help="replay this trace (CSV, may be gzipped)")
    parser.add_argument(
        "--paths",
        default="wlan0=a,wwan0=b",
        metavar="IF=P,..",
        help="path of the trace for each interface (%(default)s)",
    )
    parser.add_argument("--repeat", action="store_true", help="repeat the trace from its start")
    actions = parser.add_subparsers(dest="action", metavar="up | shell | exec | calibrate")
    up = actions.add_parser("up", help="draw the lab, show live statistics, take commands from stdin (default)")
    up.add_argument("--every", type=float, default=2.0, metavar="S", help="seconds between statistics")
    shell = actions.add_parser("shell", help="open a shell on a host")
    shell.add_argument("host")
    execute = actions.add_parser("exec", help="run one program on a host")
    execute.add_argument("host")
    execute.add_argument("command", nargs=argparse.REMAINDER, metavar="-- CMD ...")
    actions.add_parser("calibrate", help="measure packets per second and added delay of the emulator on this machine")
    return parser


def _parse_paths(text: str) -> dict[str, str]:
    paths = {}
    for item in text.split(","):
        interface, equals, path = item.partition("=")
        if not equals:
            raise LabConfigError(f"--paths: expected INTERFACE=PATH, got {item!r}")
        paths[interface] = path
    return paths


def _run(lab: Lab, arguments: argparse.Namespace) -> int:
    match arguments.action:
        case "shell":
            print(lab.drawing())
            return _foreground(lab, arguments.host, [os.environ.get("SHELL", "/bin/sh")])
        case "exec":
            return _foreground(lab, arguments.host, arguments.command)
        case "calibrate":
            result = calibrate(lab, lab.config.robots[0].interfaces[0].name)
            print(
                f"{result.packets_per_s:.0f} packets/s of 1200 bytes at {result.cpu_share:.0%} of a core; "
                f"adds {result.added_p50_us:.0f} us (P50), {result.added_p99_us:.0f} us (P99) one way; "
                f"{result.port_kind} ports, {'real-time' if result.realtime else 'ordinary'} scheduling"
            )
            return 0
        case _:
            return _watch(lab, getattr(arguments, "every", 2.0))


def _foreground(lab: Lab, host: str, command: list[str]) -> int:
    process = lab.host(host).popen(command, stdin=sys.stdin, new_session=False)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the program's
    code = process.wait()
    return code if code >= 0 else 128 - code


def _watch(lab: Lab, every_s: float) -> int:
    print(lab.drawing())
    for name, host in lab.hosts.items():
        print(f"enter {name}: {' '.join(host.enter_command('/'))} sh")
    print("commands: help, quit, or as `wlan0 delay_ms=50 loss=0.1`", flush=True)
    before: dict[tuple[str, str], LinkStats] = {}
    watched = [sys.stdin.fileno()]
    typed = ""
    next_report = time.monotonic()
    while True:
        ready, _, _ = select.select(watched, (), (), max(0.0, next_report - time.monotonic()))
        if ready:
            data = os.read(sys.stdin.fileno(), 4096)
            if not data:  # stdin is closed: go on without commands
                watched = []
            *lines, typed = (typed + data.decode(errors="replace")).split("\n")
            for line in filter(None, map(str.strip, lines)):
                if line in ("quit", "exit"):
                    return 0
                _obey(lab, line)
            continue
        next_report += every_s
        for key, link in lab.links.items():
            stats = link.stats(reset=True)
            print(_stats_line(key, stats, before.get(key), every_s), flush=True)
            before[key] = stats


def _obey(lab: Lab, line: str) -> None:
    if line == "help":
        print(commands.__doc__)
        return
    try:
        apply_command(lab, parse_command(line))
    except (LabConfigError, LabError) as error:
        print(error)


def _stats_line(key: tuple[str, str], stats: LinkStats, before: LinkStats | None, every_s: float) -> str:
    parts = [f"{key[0]}/{key[1]}" + (f" {stats.dark.upper()}" if stats.dark else "")]
    for name in ("up", "down"):
        now = getattr(stats, name)
        then = getattr(before, name) if before is not None else None
        bits = (now.delivered_bytes - (then.delivered_bytes if then else 0)) * 8
        drops = ", ".join(f"{reason} {count}" for reason, count in now.drops.items() if count) or "none"
        parts.append(
            f"{name} {bits / every_s / 1000:.0f} kbit/s of {_rate(now.profile.rate_kbps)},"
            f" {now.profile.delay_ms:g} ms, queue {now.queue_bytes} B, dropped: {drops}"
        )
    parts.append(f"late P99 {stats.lateness.p99_s * 1e3:.2f} ms, max {stats.lateness.max_s * 1e3:.2f} ms")
    return " | ".join(parts)


def _rate(kbps: float | None) -> str:
    return "unlimited" if kbps is None else f"{kbps:g}"


if __name__ == "__main__":
    sys.exit(main())
