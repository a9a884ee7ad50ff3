"""`plr events`: shows what happened in the fleet, from the control plane's event log."""

from __future__ import annotations

import argparse
import re
import sys
import time
from dataclasses import replace
from datetime import UTC, datetime
from typing import TYPE_CHECKING

from plr.controlplane.cli import event_text
from plr.controlplane.cli.admin_client import AskError, add_options, ask
from plr.controlplane.observe import event_lines
from plr.protos.convert import event_list_from_proto, event_query_to_proto
from plr.protos.model.fleet_events import EventQuery
from plr.protos.model.names import node_name
from plr.protos.program.arguments import checked, whole
from plr.protos.program.exit_codes import EXIT_OK

if TYPE_CHECKING:
    from plr.protos.model.fleet_events import EventList
    from plr.protos.program.arguments import Commands


LAST = 100

FOLLOW_S = 2.0
"""Interval between two queries with --follow."""

_UNITS_S = {"s": 1.0, "m": 60.0, "h": 3600.0, "d": 86_400.0}

_EPILOG = """\
shows: who connected, lost its stream, was refused, and who is gone and why (lease_expired, certificate_expired,
revoked, drained, left, policy); refusals of what was sent; the control plane's own starts and stops. Times are UTC.
With --json each event is a line of its own. What each kind means: docs/operate/events.md.

examples:
  plr events --tls-dir ~/.plr/alice --address control.example.org:50051
  plr events --tls-dir ~/.plr/alice --node robot-7 --since 2h
  plr events --insecure --since 2026-03-01T08:00 --json > monday.jsonl
  plr events --insecure --follow
"""


def add_to(commands: Commands, summary: str) -> None:
    """Add the command to `plr`."""
    events = commands.add_parser(
        "events",
        help=summary,
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    events.add_argument("--node", type=checked(node_name), metavar="NAME", help="show only events of this sidecar")
    events.add_argument(
        "--since",
        type=_since,
        default=0.0,
        metavar="WHEN",
        help="show events from 90s, 30m, 2h or 7d ago on, or from a time on (UTC unless it has a zone)",
    )
    events.add_argument(
        "--last",
        type=whole(0, 1 << 31),
        metavar="N",
        help=f"show at most this many, the newest; 0: all (default {LAST}; with --since all)",
    )
    events.add_argument("--follow", action="store_true", help="keep showing new events until Ctrl-C")
    add_options(events)
    events.set_defaults(run=_events)


def _since(text: str) -> float:
    ago = re.fullmatch(r"(\d+(?:\.\d+)?)([smhd])", text)
    if ago is not None:
        return max(0.0, time.time() - float(ago[1]) * _UNITS_S[ago[2]])
    try:
        at = datetime.fromisoformat(text)
        return max(0.0, (at if at.tzinfo is not None else at.replace(tzinfo=UTC)).timestamp())
    except (ValueError, OverflowError):
        raise argparse.ArgumentTypeError(f"expected 30m, 2h, 7d, 2026-03-01T08:00 or the like, got {text!r}") from None


def _events(arguments: argparse.Namespace) -> int:
    last = arguments.last
    if last is None:
        last = 0 if arguments.since else LAST
    query = EventQuery(arguments.node, 0, arguments.since, last)
    try:
        found = _ask(arguments, query)
        _show(found, as_json=arguments.json)
        if not found.events and arguments.node is not None:
            sys.stderr.write(f"plr: no event of {arguments.node} was found; plr status shows how names are spelled\n")
        if found.left_out and not arguments.json:
            sys.stderr.write(f"plr: {found.left_out} older events are not shown; --last 0 shows all\n")
        while arguments.follow:
            time.sleep(FOLLOW_S)
            after = found.events[-1].number if found.events else query.after
            query = replace(query, after=after, last=0)
            found = _follow(arguments, query)
            _show(found, as_json=arguments.json)
    except AskError as error:
        sys.stderr.write(f"plr: {error}\n")
        return error.code
    except KeyboardInterrupt:
        return EXIT_OK
    return EXIT_OK


def _ask(arguments: argparse.Namespace, query: EventQuery) -> EventList:
    request = event_query_to_proto(query)
    return ask(arguments, lambda stub, timeout_s: event_list_from_proto(stub.ListEvents(request, timeout=timeout_s)))


def _follow(arguments: argparse.Namespace, query: EventQuery) -> EventList:
    """Ask until there is an answer: a restart of the control plane is just what one wants to follow."""
    told = False
    while True:
        try:
            return _ask(arguments, query)
        except AskError as error:
            if not told:
                sys.stderr.write(f"plr: {error}; trying again\n")
            told = True
            time.sleep(FOLLOW_S)


def _show(found: EventList, *, as_json: bool) -> None:
    for event in found.events:
        sys.stdout.write(f"{event_lines.encode(event) if as_json else event_text.line(event)}\n")
    sys.stdout.flush()
