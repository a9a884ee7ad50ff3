"""`plr explain`: shows why a robot's requests for a service go where they go."""

from __future__ import annotations

import argparse
import sys
from typing import TYPE_CHECKING

from plr.controlplane.cli import explanation_text
from plr.controlplane.cli.admin_client import AskError, add_options, ask
from plr.protos.convert import explanation_from_proto
from plr.protos.model.names import node_name, service_name
from plr.protos.plr.v1 import admin_pb2
from plr.protos.program.arguments import checked
from plr.protos.program.exit_codes import EXIT_OK

if TYPE_CHECKING:
    from plr.protos.model.explanation import Explanation
    from plr.protos.plr.v1 import admin_pb2_grpc
    from plr.protos.program.arguments import Commands


_EPILOG = """\
shows: the mapping in force and its reason; for each pair of an interface and a server, the estimated probability that
it misses the deadline (epsilon) and the evidence for that; which interfaces fail together; what other mappings would
give; the last changes. How each is computed: docs/develop/theory.md.

examples:
  plr explain --tls-dir ~/.plr/alice robot-7 /plan
  plr explain --insecure --json robot-7 /plan > robot-7.json
  plr plan --recorded robot-7.json --target 0.001
"""


def add_to(commands: Commands, summary: str) -> None:
    """Add the command to `plr`."""
    explain = commands.add_parser(
        "explain",
        help=summary,
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    explain.add_argument("robot", type=checked(node_name), metavar="ROBOT")
    explain.add_argument("service", type=checked(service_name), metavar="SERVICE")
    add_options(explain)
    explain.set_defaults(run=_explain)


def _explain(arguments: argparse.Namespace) -> int:
    request = admin_pb2.ExplainRequest(robot=arguments.robot, service=arguments.service)

    def call(stub: admin_pb2_grpc.AdminStub, timeout_s: float) -> tuple[admin_pb2.ExplainResponse, Explanation]:
        answer = stub.Explain(request, timeout=timeout_s)
        return answer, explanation_from_proto(answer)

    try:
        answer, explanation = ask(arguments, call)
    except AskError as error:
        sys.stderr.write(f"plr: {error}\n")
        return error.code
    if arguments.json:
        from google.protobuf import json_format

        text = json_format.MessageToJson(answer, preserving_proto_field_name=True)
    else:
        text = explanation_text.render(explanation)
    sys.stdout.write(f"{text}\n")
    return EXIT_OK
