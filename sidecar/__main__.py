"""Runs plr-sidecar: command line, logging and signals around `runtime.run`."""

from __future__ import annotations

import argparse
import faulthandler
import json
import logging
import math
import os
import signal
import sys
import threading
import time
from pathlib import Path
from typing import TYPE_CHECKING

from plr.protos.program import commit, endings, extras
from plr.protos.program.exit_codes import EXIT_FAILED, EXIT_OK, EXIT_USAGE

with extras.required("plr-sidecar", "sidecar"):
    from plr.protos.base.errors import ConfigError, StartError
    from plr.protos.base.printable import escaped
    from plr.protos.model.ids import Role
    from plr.protos.program.arguments import OneLineParser
    from plr.protos.program.certificate_term import term_problem
    from plr.protos.program.log_lines import line_formatter
    from plr.protos.program.logging_setup import Logging
    from plr.protos.program.tls_files import load_tls_files
    from plr.protos.program.version_option import ShowVersion
    from plr.sidecar.config.service_user import unreadable, unreadable_program
    from plr.sidecar.config.sidecar import SidecarConfig, config_schema, load_config, refuse_exposed
    from plr.sidecar.ros import environment, static_peers
    from plr.sidecar.stop_request import StopRequest

if TYPE_CHECKING:
    from collections.abc import Sequence

    from plr.protos.program.certificate_term import TermProblem

log = logging.getLogger("plr.sidecar.main")

PROGRAM = "plr-sidecar"

SHORT_DEADLINE_MS = 1.0
"""A deadline below this was probably meant in seconds."""

IMPATIENT_AFTER_S = 1.0
"""A signal this long after the first ends the program at once; an earlier one is the same, also sent to a group."""

_DESCRIPTION = "Carries the ROS 2 service calls of a robot to cloud servers over every network interface."

_EPILOG = """\
examples:
  plr-sidecar --config /etc/plr/sidecar.yaml                  run until SIGTERM or Ctrl-C
  plr-sidecar --config /etc/plr/sidecar.yaml --check-config   check the configuration and exit
  plr-sidecar --print-schema > sidecar.schema.json            print a schema for an editor

exit codes:
  0  stopped on request, or the configuration is valid
  1  failed at run time, or state_dir cannot be used (--check-config does not try it); the log says why
  2  wrong usage or configuration; one line on stderr names the file, the key and the expected value
"""


@endings.ends_quietly(PROGRAM)
def main(arguments: Sequence[str] | None = None) -> int:
    """Run the program and return its exit code."""
    options = _parser().parse_args(arguments)
    if options.print_schema:
        sys.stdout.write(json.dumps(config_schema(), indent=2) + "\n")
        return EXIT_OK
    if options.config is None:
        _parser().error("expected --config FILE")
    lacking = extras.missing("sidecar", extras.SIDECAR)
    if lacking is not None:
        sys.stderr.write(f"{PROGRAM}: {lacking}\n")
        return EXIT_USAGE
    try:
        config = load_config(options.config, lambda folder: load_tls_files(folder).identity)
        if not options.insecure_i_know:
            refuse_exposed(config, str(options.config))
        if options.check_config:
            _warn_of_missing_interfaces(config)
            _warn_of_short_deadlines(config)
            _check_certificate(config)
            _warn_of_unreadable_files(options.config, config)
            _check_ros(thorough=True)
            _warn_of_unresolvable_peers()
            _warn_of_missing_types(config)
            sys.stdout.write(f"{escaped(str(options.config))}: ok\n")
            return EXIT_OK
        return _run(config)
    except ConfigError as error:
        # An error found after the file was read lacks the file's name; one without a key belongs to another file.
        located = ConfigError(str(options.config), error.key, error.problem) if error.key else error
        sys.stderr.write(f"{PROGRAM}: {located}\n")
        return EXIT_FAILED if isinstance(error, StartError) else EXIT_USAGE


def _parser() -> argparse.ArgumentParser:
    parser = OneLineParser(
        prog=PROGRAM,
        description=_DESCRIPTION,
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    parser.add_argument("--config", type=Path, metavar="FILE", help="configuration, YAML")
    parser.add_argument("--check-config", action="store_true", help="check the configuration and exit")
    parser.add_argument("--print-schema", action="store_true", help="print the configuration's JSON Schema and exit")
    parser.add_argument(
        "--insecure-i-know",
        action="store_true",
        help="accept insecure: true with a control plane on another machine: anybody in between can read and change "
        "all data",
    )
    parser.add_argument("--version", action=ShowVersion)
    return parser


def _warn_of_missing_interfaces(config: SidecarConfig) -> None:
    from plr.sidecar.net.interfaces import list_interfaces, missing_interfaces

    described = [network.interface for network in config.networks]
    for line in missing_interfaces(list_interfaces(), config.interfaces, described):
        sys.stderr.write(f"{PROGRAM}: warning: {line}\n")


def _warn_of_short_deadlines(config: SidecarConfig) -> None:
    for number, service in enumerate(config.services):
        if service.deadline_ms is not None and service.deadline_ms < SHORT_DEADLINE_MS:
            problem = (
                f"{service.deadline_ms:g} ms is shorter than the round trip of any network; the unit is milliseconds"
            )
            sys.stderr.write(f"{PROGRAM}: warning: services[{number}].deadline_ms: {problem}\n")


def _check_ros(*, thorough: bool) -> None:
    problem = environment.problem(thorough=thorough)
    if problem is not None:
        raise ConfigError("", "", problem)


def _warn_of_unresolvable_peers() -> None:
    left_out = static_peers.unresolvable(os.environ)
    if left_out:
        sys.stderr.write(f"{PROGRAM}: warning: {escaped(static_peers.told(left_out))}\n")


def _warn_of_missing_types(config: SidecarConfig) -> None:
    if config.role is not Role.ROBOT:
        return  # the type of a local server is only known when it runs
    from plr.sidecar.ros.graph.missing_types import missing_types
    from plr.sidecar.state.store import peek_last_good

    peers = peek_last_good(config.state_dir, config.node_name).peers
    for line in missing_types(peers.peers if peers is not None else (), config.service_rules()):
        sys.stderr.write(f"{PROGRAM}: warning: {escaped(line)}\n")


def _certificate_problem(config: SidecarConfig) -> TermProblem | None:
    if config.tls_dir is None:
        return None
    return term_problem(load_tls_files(config.tls_dir), time.time())


def _check_certificate(config: SidecarConfig) -> None:
    problem = _certificate_problem(config)
    if problem is None:
        return
    if not problem.in_force:
        raise ConfigError("", "", problem.text)
    sys.stderr.write(f"{PROGRAM}: warning: {problem.text}\n")


def _warn_of_unreadable_files(path: Path, config: SidecarConfig) -> None:
    for found in (unreadable(path, config.tls_dir), unreadable_program(path)):
        if found is None:
            continue
        sys.stderr.write(f"{PROGRAM}: warning: {escaped(f'{found.text}; do: {found.remedy}')}\n")


def _run(config: SidecarConfig) -> int:
    _check_ros(thorough=False)
    faulthandler.enable()
    # gRPC's own lines on stderr have another format, and our log says the same.
    os.environ.setdefault("GRPC_VERBOSITY", "ERROR")
    stop = StopRequest()
    logs = Logging("plr.sidecar", config.log_level.value, sys.stderr, line_formatter(sys.stderr, "plr.sidecar"))
    with logs:
        failure = _stop_on_signals_and_crashes(stop)
        try:
            problem = _certificate_problem(config)
            if problem is not None:
                # Start anyway: the clock is set soon after a boot, and a replaced certificate is read again.
                log.log(logging.WARNING if problem.in_force else logging.ERROR, "%s", problem.text)
            # Imported late, as it takes a second, several on a busy machine: a wrong configuration has been reported by
            # now, and signals are handled meanwhile.
            try:
                from plr.sidecar.runtime import run
            except ImportError:
                # The first check cannot see this: rclpy is there, but one of its libraries is missing.
                _check_ros(thorough=True)
                raise

            code = run(config, commit.version(), stop)
        except ConfigError:
            raise
        except Exception:
            log.critical("failed", exc_info=True)
            code = EXIT_FAILED
    if failure.is_set():
        code = EXIT_FAILED
    logs.end_if_stalled(code)
    return code


def _stop_on_signals_and_crashes(stop: StopRequest) -> threading.Event:
    """Set `stop` on SIGTERM, on SIGINT and when a thread dies; return the event that is set in the last case."""
    failure = threading.Event()
    stopping_since = math.inf

    def on_signal(number: int, _frame: object) -> None:
        nonlocal stopping_since
        now = time.monotonic()
        if now - stopping_since > IMPATIENT_AFTER_S:
            signal.signal(number, signal.SIG_DFL)
            signal.raise_signal(number)
        stopping_since = min(stopping_since, now)
        stop.set(f"on {signal.Signals(number).name}")

    def on_crash(crash: threading.ExceptHookArgs) -> None:
        name = crash.thread.name if crash.thread else "a thread"
        value = crash.exc_value or crash.exc_type()
        log.critical("%s died: the sidecar stops", name, exc_info=(crash.exc_type, value, crash.exc_traceback))
        failure.set()
        stop.set(f"because {name} died")

    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, on_signal)
    threading.excepthook = on_crash
    return failure


if __name__ == "__main__":
    sys.exit(main())
