"""plr: ask a running control plane, plan ahead, certify nodes, try out a policy, look up configuration keys.

on a robot or a server itself, without the control plane (each has --help):
  plr doctor               look at this node: what is wrong, and what to do
  plr ping PEER            how long each path to a peer takes
  plr bugreport            a tar file for whoever helps

examples:
  plr status --tls-dir ~/.plr/alice --address control.example.org:50051
  plr status --insecure --json
  plr explain --tls-dir ~/.plr/alice robot-7 /plan
  plr events --tls-dir ~/.plr/alice --node robot-7 --since 2h
  plr plan --traces drive.csv.gz --request-bytes 120000 --deadline-ms 250 --target 0.01
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
import base64
import json
import subprocess
import sys
import time
from ipaddress import ip_address
from typing import TYPE_CHECKING

from google.protobuf import json_format

from controlplane import (
    event_text,
    events_command,
    explain_command,
    plan_command,
    policy_command,
    status_table,
)
from controlplane.admin_client import AskError, add_options, ask
from controlplane.ca import commands as ca_commands
from controlplane.config import ControlPlaneConfig
from protos.convert import (
    departed_from_proto,
    events_from_proto,
    log_state_from_proto,
    own_revocations_from_proto,
    status_from_proto,
)
from protos.plr.v1 import admin_pb2
from protos.version_option import ShowVersion

if TYPE_CHECKING:
    from collections.abc import Sequence

EXIT_OK = 0


def main(argv: Sequence[str] | None = None) -> int:
    """Run the program; returns its exit code."""
    arguments = _parser().parse_args(argv)
    code: int = arguments.run(arguments)
    return code


def _parser() -> argparse.ArgumentParser:
    summary, _, epilog = (__doc__ or "").partition("\n\n")
    parser = argparse.ArgumentParser(
        prog="plr",
        description=summary,
        epilog=epilog,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action=ShowVersion)
    commands = parser.add_subparsers(required=True, metavar="COMMAND")

    status = commands.add_parser("status", help="who is connected, how far each follows, and who is gone")
    add_options(status)
    status.set_defaults(run=_status)

    explain_command.add_to(commands)
    events_command.add_to(commands)
    plan_command.add_to(commands)
    ca_commands.add_to(commands)

    config = commands.add_parser("config", help="about configuration files")
    about = config.add_subparsers(required=True, metavar="COMMAND")
    schema = about.add_parser("schema", help="print the JSON Schema of a program's configuration")
    schema.add_argument("program", choices=["controlplane", "sidecar"])
    schema.set_defaults(run=_schema)

    policy_command.add_to(commands)
    return parser


def _status(arguments: argparse.Namespace) -> int:
    try:
        answer, (sidecars, own, gone, events, state) = ask(
            arguments,
            lambda stub, timeout_s: stub.GetStatus(admin_pb2.GetStatusRequest(), timeout=timeout_s),
            lambda message: (
                status_from_proto(message),
                own_revocations_from_proto(message),
                departed_from_proto(message.departed),
                events_from_proto(message.events),
                log_state_from_proto(message.log),
            ),
        )
    except AskError as error:
        sys.stderr.write(f"plr: {error}\n")
        return error.code
    if arguments.json:
        print(_status_json(answer))
    else:
        print(status_table.render(sidecars, own, time.time()))
        for section in (event_text.departed(gone, answer.departed_left_out), event_text.events(events, state)):
            lines = list(section)
            if lines:
                print("", *lines, sep="\n")
    return EXIT_OK


def _status_json(answer: admin_pb2.GetStatusResponse) -> str:
    """Return the answer in protobuf's JSON, but addresses as people write them: bytes would be base64."""
    shown = json_format.MessageToDict(answer, preserving_proto_field_name=True)
    for sidecar in shown.get("sidecars", ()):
        for candidate in sidecar.get("peer", {}).get("candidates", ()):
            address = candidate.get("address", {})
            if "ip" in address:
                address["ip"] = str(ip_address(base64.b64decode(address["ip"])))
    return json.dumps(shown, indent=2)


def _schema(arguments: argparse.Namespace) -> int:
    if arguments.program == "sidecar":
        # The planes do not import each other: the program that has these keys is asked.
        return subprocess.run([sys.executable, "-m", "sidecar", "--print-schema"], check=False).returncode
    print(json.dumps(ControlPlaneConfig.model_json_schema(), indent=2))
    return EXIT_OK


if __name__ == "__main__":
    sys.exit(main())
