"""`plr policy`: shows what the access policy of a configuration file says, without a running control plane."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING

from plr.controlplane.config.controlplane import load_config
from plr.controlplane.core.policy.explain import explain
from plr.protos.base.errors import ConfigError
from plr.protos.model.names import node_name, service_name
from plr.protos.program.arguments import checked
from plr.protos.program.exit_codes import EXIT_NO, EXIT_OK, EXIT_USAGE

if TYPE_CHECKING:
    import argparse

    from plr.protos.program.arguments import Commands


def add_to(commands: Commands, summary: str) -> None:
    """Add the command to `plr`."""
    policy = commands.add_parser("policy", help=summary)
    about = policy.add_subparsers(required=True, metavar="COMMAND")
    check = about.add_parser(
        "check",
        help="whether a robot may call a service on a cloud, and which rules say so",
        epilog="exit codes: 0 allowed, 1 denied, 2 bad usage or configuration",
    )
    check.add_argument("--config", type=Path, required=True, metavar="FILE", help="the control plane's configuration")
    check.add_argument("--robot", type=checked(node_name), required=True, metavar="NAME")
    check.add_argument("--service", type=checked(service_name), required=True, metavar="NAME")
    check.add_argument("--cloud", type=checked(node_name), required=True, metavar="NAME")
    check.set_defaults(run=_check)


def _check(arguments: argparse.Namespace) -> int:
    try:
        policy = load_config(arguments.config).settings().policy
    except ConfigError as error:
        sys.stderr.write(f"plr: {error}\n")
        return EXIT_USAGE
    decision = explain(policy, arguments.robot, arguments.service, arguments.cloud)
    lines = ["allowed" if decision.allowed else "denied", *(f"  {reason}" for reason in decision.reasons)]
    sys.stdout.write("\n".join(lines) + "\n")
    return EXIT_OK if decision.allowed else EXIT_NO
