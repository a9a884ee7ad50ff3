"""plr-controlplane: discovers the sidecars, gathers what they measure, and tells robots where to send requests.

examples:
  plr-controlplane --config /etc/plr/controlplane.yaml
  plr-controlplane --config /etc/plr/controlplane.yaml --check-config

signals: SIGHUP reads the policy in the configuration again; SIGTERM and SIGINT stop

exit codes: 0 stopped cleanly, 1 failed while running, 2 bad usage or configuration
"""

from __future__ import annotations

import argparse
import asyncio
import logging
import resource
import signal
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING

from plr.protos.program import endings, extras, interpreter
from plr.protos.program.exit_codes import EXIT_FAILED, EXIT_OK, EXIT_USAGE

with extras.required("plr-controlplane", "controlplane"):
    from plr.controlplane.config.controlplane import load_config, refuse_exposed
    from plr.controlplane.serve.certificate_watch import load_own_files
    from plr.protos.base.errors import ConfigError
    from plr.protos.base.printable import escaped
    from plr.protos.program.arguments import OneLineParser
    from plr.protos.program.certificate_term import term_problem
    from plr.protos.program.log_lines import line_formatter
    from plr.protos.program.logging_setup import Logging
    from plr.protos.program.version_option import ShowVersion, describe

if TYPE_CHECKING:
    from collections.abc import Sequence

    from plr.controlplane.config.controlplane import ControlPlaneConfig
    from plr.controlplane.serve.server import Addresses
    from plr.protos.program.tls_files import TlsFiles


_NO_STUN_SERVERS = (
    "stun_servers is empty: sidecars get no STUN server, and robots behind a NAT stay unreachable unless their own "
    "configuration names one"
)

log = logging.getLogger("plr.controlplane")


@endings.ends_quietly("plr-controlplane")
def main(argv: Sequence[str] | None = None) -> int:
    """Run the program and return its exit code."""
    arguments = _parser().parse_args(argv)
    lacking = extras.missing("controlplane", extras.CONTROL_PLANE)
    if lacking is not None:
        sys.stderr.write(f"plr-controlplane: {lacking}\n")
        return EXIT_USAGE
    try:
        config = load_config(arguments.config)
        if not arguments.insecure_i_know:
            refuse_exposed(config, str(arguments.config))
        files = load_own_files(config.tls_dir) if config.tls_dir is not None else None
    except ConfigError as error:
        sys.stderr.write(f"plr-controlplane: {error}\n")
        return EXIT_USAGE
    problem = term_problem(files, time.time()) if files is not None else None
    if arguments.check_config:
        if problem is not None:
            sys.stderr.write(f"plr-controlplane: {'warning: ' if problem.in_force else ''}{problem.text}\n")
            if not problem.in_force:
                return EXIT_USAGE
        _warn_of_what_is_legal(config)
        sys.stdout.write(f"{escaped(str(arguments.config))}: ok\n")
        return EXIT_OK
    logging.getLogger("grpc._cython.cygrpc").addFilter(_is_not_a_lost_stream)
    # Write the log off the loop's thread: a stopped terminal would otherwise stop the whole fleet's control plane.
    logs = Logging("plr.controlplane", config.log_level, sys.stderr, line_formatter(sys.stderr, "plr"))
    with logs:
        if problem is not None:
            # Start all the same: the clock is set soon after boot, and a replaced certificate is read again.
            log.log(logging.WARNING if problem.in_force else logging.ERROR, "%s", problem.text)
        code = _serve(arguments.config, config, files)
    logs.end_if_stalled(code)
    return code


def _warn_of_what_is_legal(config: ControlPlaneConfig) -> None:
    """Print what a start would log as warnings: a policy that allows nothing is legal, and locks a fleet out."""
    from plr.controlplane.config.policy_reload import doubt

    warnings = [None if config.policy is None else doubt(config.policy.policy())]
    warnings.append(_NO_STUN_SERVERS if config.stun_listen and not config.stun_servers else None)
    for text in filter(None, warnings):
        sys.stderr.write(f"plr-controlplane: warning: {text}\n")


def _serve(source: Path, config: ControlPlaneConfig, files: TlsFiles | None) -> int:
    _take_descriptors()
    # Importing gRPC takes half a second; checking a configuration need not wait for that.
    from plr.controlplane.serve.server import ListenError

    try:
        asyncio.run(_run(source, config, files))
    except ListenError as error:
        log.critical("%s: %s", source, error)
        return EXIT_FAILED
    except Exception:
        log.critical("the control plane failed", exc_info=True)
        return EXIT_FAILED
    log.info("stopped")
    return EXIT_OK


def _parser() -> argparse.ArgumentParser:
    summary, _, epilog = (__doc__ or "").partition("\n\n")
    parser = OneLineParser(
        prog="plr-controlplane",
        description=summary,
        epilog=epilog,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--config", type=Path, required=True, metavar="FILE", help="YAML configuration")
    parser.add_argument("--check-config", action="store_true", help="check the configuration, then exit")
    parser.add_argument(
        "--insecure-i-know",
        action="store_true",
        help="allow insecure: true on an address that other machines can reach: anybody there can change everything",
    )
    parser.add_argument("--version", action=ShowVersion)
    return parser


def _take_descriptors() -> None:
    """Raise the limit on open files to the system's maximum: a sidecar takes three, and a shell allows only 1,024."""
    _, most = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (most, most))


def _is_not_a_lost_stream(record: logging.LogRecord) -> bool:
    """Drop gRPC's traceback for a client that leaves while its call is being ended: any client can provoke it."""
    return not record.getMessage().startswith("ExecuteBatchError raised in core")


async def _run(source: Path, config: ControlPlaneConfig, files: TlsFiles | None) -> None:
    from plr.controlplane.config.policy_reload import PolicyReload
    from plr.controlplane.serve.server import serve
    from plr.protos.program.notifier import Notifier

    interpreter.share()
    stop = asyncio.Event()
    loop = asyncio.get_running_loop()
    for number in (signal.SIGTERM, signal.SIGINT):
        loop.add_signal_handler(number, stop.set)
    reload = PolicyReload(source, config)
    loop.add_signal_handler(signal.SIGHUP, reload.request)
    systemd = Notifier()

    def ready(addresses: Addresses) -> None:
        log.info(
            "%s listens: gRPC %s, STUN %s, metrics %s",
            describe("plr-controlplane"),
            addresses.grpc,
            ", ".join(addresses.stun) or "off",
            addresses.metrics or "off",
        )
        if addresses.stun and not config.stun_servers:
            log.warning("%s", _NO_STUN_SERVERS)
        interpreter.settle()
        interpreter.collect_by_hand()
        systemd.ready()

    def stopping() -> None:
        log.info("stopping")
        systemd.stopping()

    if files is None:
        log.warning(
            "insecure: true: traffic with sidecars and operators is in clear, and everybody who reaches %s is trusted",
            config.listen,
        )

    await serve(config, files, reload, stop, ready, stopping, systemd.status)


if __name__ == "__main__":
    sys.exit(main())
