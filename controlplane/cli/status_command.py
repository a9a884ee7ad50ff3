"""`plr status`: shows who is connected, how far each follows, and who is gone."""

from __future__ import annotations

import argparse
import sys
import time
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import grpc

from plr.controlplane.cli import event_text, status_table
from plr.controlplane.cli.admin_client import AskError, add_options, ask
from plr.protos.base.errors import DecodeError
from plr.protos.convert import (
    departed_from_proto,
    events_from_proto,
    log_state_from_proto,
    own_revocations_from_proto,
    status_from_proto,
    status_query_to_proto,
)
from plr.protos.convert.fields import MAX_LISTED_SIDECARS
from plr.protos.model.names import node_name
from plr.protos.model.status import StatusQuery
from plr.protos.plr.v1 import admin_pb2
from plr.protos.program.arguments import checked
from plr.protos.program.exit_codes import EXIT_FAILED, EXIT_OK

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from plr.protos.model.fleet_events import DepartedSidecar
    from plr.protos.model.ids import NodeName
    from plr.protos.model.status import SidecarStatus
    from plr.protos.plr.v1 import admin_pb2_grpc
    from plr.protos.program.arguments import Commands


DETAILED_AT_MOST = 64
"""Most sidecars in order that are still shown with their mapping and paths: a few screens full."""

_EPILOG = """\
shows: a row for each sidecar; the mapping and paths of each, but in a fleet of more than 64 only of those with a
problem; the sidecars that are gone; the last events. Named sidecars are shown in full, and with --all all of them.

examples:
  plr status --tls-dir ~/.plr/alice --address control.example.org:50051
  plr status --tls-dir ~/.plr/alice robot-7 cloud-a
  plr status --insecure --all --json
"""


def add_to(commands: Commands, summary: str) -> None:
    """Add the command to `plr`."""
    status = commands.add_parser(
        "status", help=summary, epilog=_EPILOG, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    status.add_argument("names", nargs="*", type=checked(node_name), metavar="NAME", help="show only these sidecars")
    status.add_argument("--all", action="store_true", help="show mapping and paths of all, also in a large fleet")
    add_options(status)
    status.set_defaults(run=_status)


@dataclass(slots=True)
class _Answer:
    """The parts received so far: converted as they come and, for JSON, unchanged."""

    raw: admin_pb2.GetStatusResponse | None
    rest: admin_pb2.GetStatusResponse = field(default_factory=admin_pb2.GetStatusResponse)
    """The answer without sidecars."""
    sidecars: list[SidecarStatus] = field(default_factory=list)

    def take(self, part: admin_pb2.GetStatusResponse) -> None:
        """Add a part of the answer; raises DecodeError."""
        self.sidecars += status_from_proto(part)
        if len(self.sidecars) > MAX_LISTED_SIDECARS:
            raise DecodeError(f"sidecars has more than {MAX_LISTED_SIDECARS} elements")
        if self.raw is not None:
            self.raw.MergeFrom(part)
        del part.sidecars[:]
        self.rest.MergeFrom(part)


def _status(arguments: argparse.Namespace) -> int:
    everything = arguments.all or arguments.json or arguments.names
    query = StatusQuery(tuple(dict.fromkeys(arguments.names)), 0 if everything else DETAILED_AT_MOST)

    def call(stub: admin_pb2_grpc.AdminStub, timeout_s: float) -> tuple[_Answer, str]:
        answer = _Answer(admin_pb2.GetStatusResponse() if arguments.json else None)
        for part in _parts(stub, query, timeout_s):
            answer.take(part)
        return answer, _text(answer, query.names)

    try:
        answer, text = ask(arguments, call)
    except AskError as error:
        sys.stderr.write(f"plr: {error}\n")
        return error.code
    shown = _json(answer.raw) if answer.raw is not None else text
    sys.stdout.write(f"{shown}\n" if shown else "")
    missing = set(query.names) - {status.peer.name for status in answer.sidecars}
    for name in sorted(missing):
        sys.stderr.write(
            f"plr: {name} is not registered; plr status shows which are, plr events --node {name} shows its past\n"
        )
    return EXIT_FAILED if missing else EXIT_OK


def _parts(
    stub: admin_pb2_grpc.AdminStub, query: StatusQuery, timeout_s: float
) -> Iterable[admin_pb2.GetStatusResponse]:
    try:
        yield from stub.StreamStatus(status_query_to_proto(query), timeout=timeout_s)
    except grpc.RpcError as error:
        if getattr(error, "code", lambda: None)() is not grpc.StatusCode.UNIMPLEMENTED:
            raise
        # The control plane has the previous version.
        whole = stub.GetStatus(admin_pb2.GetStatusRequest(), timeout=timeout_s)
        if query.names:
            kept = [sidecar for sidecar in whole.sidecars if sidecar.peer.name in query.names]
            del whole.sidecars[:]
            whole.sidecars.extend(kept)
        yield whole


def _text(answer: _Answer, names: Sequence[NodeName]) -> str:
    rest = answer.rest
    gone: Sequence[DepartedSidecar] = departed_from_proto(rest.departed)
    if names:
        gone = [one for one in gone if one.name in names]
        rest.departed_left_out = 0
        del rest.events[:]
    lines = []
    if answer.sidecars or not names:
        lines.append(status_table.render(answer.sidecars, own_revocations_from_proto(rest), time.time()))
    for section in (
        event_text.departed(gone, rest.departed_left_out),
        event_text.events(events_from_proto(rest.events), log_state_from_proto(rest.log)),
    ):
        found = list(section)
        if found:
            lines += ["", *found] if lines else found
    return "\n".join(lines)


def _json(answer: admin_pb2.GetStatusResponse) -> str:
    """Return the answer as protobuf's JSON, but with readable addresses: bytes would be base64."""
    import base64
    import json
    from ipaddress import ip_address

    from google.protobuf import json_format

    shown = json_format.MessageToDict(answer, preserving_proto_field_name=True)
    for sidecar in shown.get("sidecars", ()):
        for candidate in sidecar.get("peer", {}).get("candidates", ()):
            address = candidate.get("address", {})
            if "ip" in address:
                address["ip"] = str(ip_address(base64.b64decode(address["ip"])))
    return json.dumps(shown, indent=2)
