"""plr ping: measure the round trip of each path to a peer, with data-plane datagrams that its sidecar answers.

examples:
  plr ping cloud-1                      over each path, once a second, until Ctrl-C
  plr ping cloud-1 -c 10 -i 0.2         ten times, five times a second
  plr ping cloud-1 -I wwan0 -s 1200     over one interface, datagrams of 1200 bytes
  plr ping robot-7 -c 3 --config /etc/plr/sidecar.yaml

It works while a path rests, and does not change what the sidecar knows about it. A path that is down is not pinged:
the sidecar itself checks whether it comes back.

exit codes: 0 something was answered, 1 nothing was, 2 bad usage
"""

from __future__ import annotations

import json
import math
import sys
import time
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from plr.protos.base.errors import ConfigError, DecodeError
from plr.protos.base.printable import escaped
from plr.protos.model.names import interface_name, node_name
from plr.protos.program.arguments import checked, number, whole
from plr.protos.program.exit_codes import EXIT_NO, EXIT_OK
from plr.sidecar.core.link.pinging import LEAST_BYTES
from plr.sidecar.core.wire.frame import MAX_DATAGRAM_BYTES
from plr.sidecar.doctor.examination import connect, read_config
from plr.sidecar.doctor.finding import share
from plr.sidecar.doctor.options import parser_of, where_of
from plr.sidecar.local.client import LocalBusyError, LocalError, refusal

if TYPE_CHECKING:
    import argparse
    from collections.abc import Callable, Sequence

    from plr.protos.model.ids import InterfaceName
    from plr.sidecar.config.sidecar import SidecarConfig
    from plr.sidecar.doctor.examination import Where
    from plr.sidecar.local.client import LocalClient

LEAST_INTERVAL_S = 0.1
"""The sidecar sends at most 20 pings a second over an interface."""
DEFAULT_BYTES = 64
MAX_INTERFACE_CHARACTERS = 15
"""Linux's limit."""
MAX_PINGED_PATHS = 4096
"""Paths to one peer; more are not counted."""
MAX_AWAITED_TURNS = 128
"""Turns whose answers are awaited."""


@dataclass(slots=True)
class PathTally:
    """Results of the pings over one path."""

    asked: int = 0
    rtts_s: list[float] = field(default_factory=list)
    unsent: int = 0
    """Requested pings that did not leave, for a reported reason. They do not count as lost."""
    waiting: set[int] = field(default_factory=set)
    """The latest turns without any result yet."""

    @property
    def sent(self) -> int:
        """Number of pings that left, as far as is known."""
        return self.asked - self.unsent

    def line(self) -> str:
        """Return the statistics in one line."""
        lost = 1.0 - len(self.rtts_s) / self.sent if self.sent else 0.0
        text = f"{self.sent} sent, {len(self.rtts_s)} answered, {share(max(0.0, lost))} lost"
        if self.unsent:
            text += f", {self.unsent} not sent"
        if self.rtts_s:
            ordered = sorted(self.rtts_s)
            figures = (ordered[0], sum(ordered) / len(ordered), quantile(ordered, 0.99), ordered[-1])
            text += f", min/avg/P99/max {'/'.join(f'{one * 1000:.2f}' for one in figures)} ms"
        return text


def quantile(ordered: Sequence[float], part: float) -> float:
    """Return the smallest value that at least this part of the values do not exceed; they are sorted and not empty."""
    return ordered[max(0, math.ceil(part * len(ordered)) - 1)]


class Pinger:
    """Sends rounds of pings to one peer, and prints the results."""

    def __init__(
        self, client: LocalClient, peer: str, interface: str | None, size: int, say: Callable[[str], None]
    ) -> None:
        self.tallies: dict[tuple[str, int], PathTally] = {}
        """Results by interface and number of the peer's interface."""
        self._client = client
        self._peer = peer
        self._interface = interface
        self._size = size
        self._say = say
        self.refused = 0
        """Requests that the sidecar refused, as it had others to answer."""
        self._rounds: dict[int, int] = {}
        """Turn of each outstanding request."""

    def run(self, count: int | None, interval_s: float, wait_s: float) -> None:
        """Ping `count` times (None: forever); raises LocalError."""
        turn = 0
        next_at = time.monotonic()
        while count is None or turn < count:
            turn += 1
            self._rounds[self._client.ping(self._peer, self._interface, self._size)] = turn
            next_at += interval_s
            self._listen(next_at, only_while_out=turn == count)
        if self._rounds:
            self._listen(time.monotonic() + wait_s, only_while_out=True)

    def _listen(self, until: float, *, only_while_out: bool) -> None:
        while self._rounds or not only_while_out:
            line = self._client.next_line(until - time.monotonic())
            if line is None:
                return
            self._take(line)

    def _take(self, line: dict[str, Any]) -> None:
        request = line.get("id") or 0
        turn = self._rounds.get(request, 0)
        if "error" in line:
            self._rounds.pop(request, None)
            if not turn or not (self.tallies or line.get("busy")):
                raise refusal(line)
            self.refused += 1
            self._say(f"seq={turn}: {line['error']}")
        elif line.get("end"):
            self._rounds.pop(request, None)
        elif line.get("part") == "pinged":
            for one in line["value"][:MAX_PINGED_PATHS]:
                self._pinged(turn, (one["interface"], one["remote"]))
        elif line.get("part") == "pong" and turn:
            self._pong(turn, line["value"])

    def _pinged(self, turn: int, key: tuple[str, int]) -> None:
        if len(self.tallies) >= MAX_PINGED_PATHS and key not in self.tallies:
            return
        tally = self.tallies.setdefault(key, PathTally())
        if turn and turn not in tally.waiting:
            tally.asked += 1
            tally.waiting = {one for one in tally.waiting if one > turn - MAX_AWAITED_TURNS} | {turn}

    def _pong(self, turn: int, pong: dict[str, Any]) -> None:
        key = pong["interface"], pong["remote"]
        tally = self.tallies.get(key)
        if tally is None or turn not in tally.waiting:
            return
        tally.waiting.discard(turn)
        name = self.name(*key)
        if pong["problem"]:
            tally.unsent += 1
            self._say(f"{name}: seq={turn} {pong['problem']}")
        else:
            tally.rtts_s.append(pong["rtt_s"])
            self._say(f"{name}: seq={turn} time={pong['rtt_s'] * 1000:.2f} ms")

    def name(self, interface: str, remote: int) -> str:
        """Return the name of a path; the peer's interface is numbered if it has several."""
        several = len({other for _, other in self.tallies}) > 1
        return f"{interface} to {self._peer}" + (f" (its interface {remote})" if several else "")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run `plr ping` and return its exit code."""
    parser = parser_of("plr ping", __doc__)
    parser.add_argument("peer", type=checked(node_name), metavar="PEER", help="a node's name, as plr doctor shows it")
    parser.add_argument("-c", "--count", type=whole(1, 1_000_000), metavar="N", help="number of pings, then stop")
    parser.add_argument(
        "-i",
        "--interval",
        type=number(LEAST_INTERVAL_S, 3600),
        default=1.0,
        metavar="S",
        help="seconds between two pings",
    )
    parser.add_argument(
        "-s",
        "--size",
        type=whole(LEAST_BYTES, MAX_DATAGRAM_BYTES),
        default=DEFAULT_BYTES,
        metavar="BYTES",
        help="bytes of UDP payload",
    )
    parser.add_argument(
        "-I", "--interface", type=checked(_interface, "the interface"), metavar="NAME", help="use this interface only"
    )
    parser.add_argument(
        "-W", "--wait", type=number(0.1, 10), default=2.0, metavar="S", help="seconds to wait for the last answers"
    )
    parser.add_argument("--json", action="store_true", help="print only the statistics, as JSON")
    options = parser.parse_args(arguments)
    try:
        with _connect(where_of(options)) as client:
            return _ping(client, options)
    except LocalError as error:
        sys.stderr.write(f"plr ping: {error}\n")
        return EXIT_NO


def _interface(name: str, what: str) -> InterfaceName:
    if len(name) > MAX_INTERFACE_CHARACTERS:
        raise DecodeError(f"{what} {name!a} is longer than an interface's, {MAX_INTERFACE_CHARACTERS} characters")
    return interface_name(name, what)


def _connect(where: Where) -> LocalClient:
    config: SidecarConfig | None = None
    if where.socket is None:
        try:
            config = read_config(where)
        except ConfigError:
            # This user may not read it, or it changed since the start: the default socket may work.
            config = None
    return connect(where, config)


def _ping(client: LocalClient, options: argparse.Namespace) -> int:
    def say(text: str) -> None:
        if not options.json:
            sys.stdout.write(escaped(text) + "\n")
            sys.stdout.flush()

    pinger = Pinger(client, options.peer, options.interface, options.size, say)
    ended: LocalError | None = None
    try:
        pinger.run(options.count, options.interval, options.wait)
    except KeyboardInterrupt:
        say("")
    except LocalError as error:
        if not pinger.tallies:
            raise
        ended = error
    if not pinger.tallies and not pinger.refused:
        raise LocalBusyError("the sidecar does not answer: it is stopped, or very busy")
    if options.json:
        sys.stdout.write(json.dumps(_figures(pinger), indent=2) + "\n")
    for key, tally in sorted(pinger.tallies.items()):
        say(f"{pinger.name(*key)}: {tally.line()}")
    if pinger.refused:
        say(f"{pinger.refused} requests were refused: the sidecar was busy with others")
    if ended is not None:
        sys.stderr.write(f"plr ping: {ended}\n")
        return EXIT_NO
    return EXIT_OK if any(tally.rtts_s for tally in pinger.tallies.values()) else EXIT_NO


def _figures(pinger: Pinger) -> list[dict[str, Any]]:
    return [
        {"interface": interface, "remote": remote, "sent": tally.sent, "unsent": tally.unsent, "rtts_s": tally.rtts_s}
        for (interface, remote), tally in sorted(pinger.tallies.items())
    ]
