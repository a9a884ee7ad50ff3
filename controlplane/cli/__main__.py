"""plr: ask a running control plane, plan ahead, certify nodes, try out a policy, look up configuration keys.

examples:
  plr status --tls-dir ~/.plr/alice --address control.example.org:50051
  plr status --insecure --json
  plr status --tls-dir ~/.plr/alice robot-7
  plr explain --tls-dir ~/.plr/alice robot-7 /plan
  plr events --tls-dir ~/.plr/alice --node robot-7 --since 2h
  plr plan --traces drive.csv.gz --request-bytes 120000 --deadline-ms 250 --target 0.01
  plr doctor
  plr ping cloud-a
  plr ca init
  plr ca issue robot-1 --role robot
  plr request robot-2 --role robot
  plr config schema controlplane
  plr config schema sidecar
  plr policy check --config /etc/plr/controlplane.yaml --robot arm-1 --service /plan --cloud cloud-a

exit codes: 0 ok, 1 the control plane cannot be reached or is not in order, or the policy
denies it, or the plan misses its target, 2 bad usage
"""

from __future__ import annotations

import argparse
import sys
from typing import TYPE_CHECKING

from plr.protos.program import extras
from plr.protos.program.arguments import OneLineParser
from plr.protos.program.version_option import ShowVersion

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from plr.protos.program.arguments import Commands

# Each command imports what it needs only when it is called: `plr status` is used where each second counts, and the
# imports of all commands together take longer than its answer.


def main(argv: Sequence[str] | None = None) -> int:
    """Run the program and return its exit code."""
    argv = sys.argv[1:] if argv is None else argv
    with extras.required("plr", "controlplane"):
        parser = _parser(argv[0] if argv else "")
    arguments = parser.parse_args(argv)
    if arguments.run is None:
        parser.error(f"expected COMMAND first, got {argv[0]!r}")
    code: int = arguments.run(arguments)
    return code


def _parser(asked_for: str) -> argparse.ArgumentParser:
    summary, _, epilog = (__doc__ or "").partition("\n\n")
    parser = OneLineParser(
        prog="plr",
        description=summary,
        epilog=epilog,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action=ShowVersion)
    parser.set_defaults(run=None)
    commands: Commands = parser.add_subparsers(required=True, metavar="COMMAND", parser_class=OneLineParser)
    for name, (about, add) in _COMMANDS.items():
        if name == asked_for:
            add(commands, about)
        else:
            commands.add_parser(name, help=about)
    for name, about in _ON_A_NODE.items():
        commands.add_parser(name, help=about)
    return parser


def _status(commands: Commands, summary: str) -> None:
    from plr.controlplane.cli import status_command

    status_command.add_to(commands, summary)


def _explain(commands: Commands, summary: str) -> None:
    from plr.controlplane.cli import explain_command

    explain_command.add_to(commands, summary)


def _events(commands: Commands, summary: str) -> None:
    from plr.controlplane.cli import events_command

    events_command.add_to(commands, summary)


def _plan(commands: Commands, summary: str) -> None:
    from plr.controlplane.cli import plan_command

    plan_command.add_to(commands, summary)


def _ca(commands: Commands, summary: str) -> None:
    from plr.controlplane.ca import commands as ca_commands

    ca_commands.add_ca(commands, summary)


def _request(commands: Commands, summary: str) -> None:
    from plr.controlplane.ca import commands as ca_commands

    ca_commands.add_request(commands, summary)


def _config(commands: Commands, summary: str) -> None:
    from plr.controlplane.cli import config_command

    config_command.add_to(commands, summary)


def _policy(commands: Commands, summary: str) -> None:
    from plr.controlplane.cli import policy_command

    policy_command.add_to(commands, summary)


_COMMANDS: dict[str, tuple[str, Callable[[Commands, str], None]]] = {
    "status": ("which sidecars are connected, what each has applied, and which are gone", _status),
    "explain": ("why a robot's requests for a service go where they go", _explain),
    "events": ("what happened in the fleet: who came, who went and why", _events),
    "plan": ("how many interfaces and servers meet a target, from recordings", _plan),
    "ca": ("issue and revoke the fleet's certificates", _ca),
    "request": ("make a key on its node, and a request to certify it", _request),
    "config": ("show the JSON Schema of the configuration files", _config),
    "policy": ("check the access policy in a control plane's configuration", _policy),
}
"""Purpose of each command, and the function that adds its options, by name."""


_ON_A_NODE = {
    "doctor": "on a robot or a server: what is wrong with this node, and what to do",
    "ping": "on a robot or a server: how long each path to a peer takes",
    "bugreport": "on a robot or a server: make a tar file for whoever helps",
}
"""The sidecar's commands, which `plr.protos.program.command_line` takes: listed, and suggested after a typo."""


if __name__ == "__main__":
    sys.exit(main())
