"""Builds one interface's datagrams: what a path owes, its probes, its queue of symbols."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

from sidecar.core import frame
from sidecar.core.frame import BASE_FRAMES_BYTES, Header
from sidecar.core.path_id import PathState

if TYPE_CHECKING:
    import random

    from protos.model import Address, InterfaceId, InterfaceName, SessionId
    from sidecar.core.paths import Path
    from sidecar.core.send_queue import Run
    from sidecar.core.stats import LinkStats

BURST_DATAGRAMS = 64
"""Datagrams built in one go before the driver looks at the socket again (about 70 kB, some milliseconds)."""

MTU_PROBE_TIMEOUTS = 3
"""A probe of the path's MTU is given up after this many of its probe timeouts, if that is longer than its own limit."""


@dataclass(frozen=True, slots=True)
class LinkIdentity:
    """Who we are on this interface."""

    interface: InterfaceName
    interface_id: InterfaceId
    session: SessionId
    token: bytes
    incarnation: int


class Batch(NamedTuple):
    """Datagrams to one address, back to back: at most 64 of them and 65,000 bytes."""

    address: Address
    data: bytes | bytearray | memoryview
    segment: int
    """Bytes of each datagram; the last may be shorter."""

    @property
    def datagrams(self) -> int:
        """How many datagrams they are."""
        return -(-len(self.data) // self.segment)

    def cut(self) -> list[memoryview]:
        """The datagrams one by one."""
        view = memoryview(self.data)
        return [view[start : start + self.segment] for start in range(0, len(view), self.segment)]


class DatagramBuilder:
    """Turns the state of a link's paths into datagrams, and notes in it what left."""

    __slots__ = ("_identity", "_rng", "_stats")

    def __init__(self, identity: LinkIdentity, stats: LinkStats, rng: random.Random) -> None:
        self._identity = identity
        self._stats = stats
        self._rng = rng

    def build(self, path: Path, out: list[Batch], now: float, *, probing: bool) -> bool:
        """Append what the path may send now; False when BURST_DATAGRAMS cut it short. `probing` allows probes."""
        before = len(out)
        if probing and path.probe_at is not None and path.probe_at <= now:
            self._add_probe(path, out, now)
        if probing and path.mtu.timer is not None and path.mtu.timer <= now:
            self._add_mtu_probe(path, out, now)
        self._add_control(path, out, now)
        complete = self._add_fragments(path, out, now)
        sent = sum(len(batch.data) for batch in out[before:])
        path.bytes_sent += sent
        self._stats.bytes["sent"] += sent
        return complete

    def _add_fragments(self, path: Path, out: list[Batch], now: float) -> bool:
        if path.state is PathState.DOWN or path.remote is None:
            return True
        recovery, control, queue = path.recovery, path.control, path.queue
        expired_before = queue.expired
        complete = True
        budget = control.budget(now, recovery.in_flight)
        while budget > 0:
            if len(out) >= BURST_DATAGRAMS:
                complete = False
                break
            run = queue.take(now, budget, control.pacing_rate or 0.0, recovery.rtt.smoothed)
            if run is None:
                control.ran_dry()
                break
            sent = self._add_run(path, path.remote, run, out, now)
            control.on_sent(now, sent, recovery.in_flight)
            budget -= sent
        if queue.expired != expired_before:
            self._stats.dropped["expired"] += queue.expired - expired_before
        return complete

    def _add_run(self, path: Path, remote: Address, run: Run, out: list[Batch], now: float) -> int:
        """Append a run's datagrams and return their bytes."""
        message = run.message
        total = 0
        for index in range(run.first, run.first + run.symbols):
            number = path.recovery.take_number()
            datagram = b"".join(
                (
                    self._header(path, number),
                    frame.encode_fragment_head(message.number, message.total, message.symbol, index),
                    message.symbol_data(index),
                )
            )
            path.recovery.on_sent(number, now, len(datagram), fragment=(message, index))
            out.append(Batch(remote, datagram, len(datagram)))
            total += len(datagram)
        path.waits_for_answer(now)
        self._stats.datagrams["sent", "data"] += run.symbols
        return total

    def _add_control(self, path: Path, out: list[Batch], now: float) -> None:
        pending = path.pending
        if path.received.ack_at is not None and (pending or path.received.ack_at <= now or len(path.queue)):
            ranges, delay = path.received.take_ack(now)
            pending.append(frame.encode_ack(ranges, delay))
        if path.remote is None:
            pending.clear()
            return
        while pending:
            taken, finished = _fill(pending)
            number = path.recovery.take_number()
            datagram = b"".join((self._header(path, number), *taken))
            if finished is not None:
                path.recovery.on_sent(number, now, len(datagram), finished=finished)
                path.waits_for_answer(now)
            out.append(Batch(path.remote, datagram, len(datagram)))
            self._stats.datagrams["sent", "control"] += 1

    def _add_probe(self, path: Path, out: list[Batch], now: float) -> None:
        probe = frame.encode_probe(frame.Probe(path.next_probe(now, self._rng)))
        if path.state is PathState.DOWN:
            me = self._identity
            probe = frame.encode_hello(frame.Hello(me.token, me.incarnation)) + probe
        for address in path.destinations():
            datagram = self._header(path, path.recovery.take_number()) + probe
            out.append(Batch(address, datagram, len(datagram)))
            self._stats.datagrams["sent", "control"] += 1

    def _add_mtu_probe(self, path: Path, out: list[Batch], now: float) -> None:
        """Add a padded probe. Nobody waits for its acknowledgement, and its loss says nothing of the rest."""
        probe_id = path.take_probe_id()
        size = path.mtu.next_probe(probe_id, now, MTU_PROBE_TIMEOUTS * path.recovery.rtt.probe_timeout(0.0))
        if size is None or path.remote is None:
            return
        head = self._header(path, path.recovery.take_number()) + frame.encode_probe(frame.Probe(probe_id))
        out.append(Batch(path.remote, head + frame.encode_padding(size - len(head)), size))
        self._stats.datagrams["sent", "control"] += 1

    def _header(self, path: Path, number: int) -> bytes:
        me = self._identity
        return frame.encode_header(Header(me.interface_id, path.remote_id, me.session, number))


def _fill(pending: list[bytes]) -> tuple[list[bytes], int | None]:
    """Take the frames of one datagram from `pending`, at most one FINISHED (its message number is returned)."""
    size = 0
    finished: int | None = None
    count = 0
    for encoded in pending:
        if size + len(encoded) > BASE_FRAMES_BYTES or count == frame.MAX_FRAMES:
            break
        if encoded[0] == frame.FINISHED_TYPE:
            if finished is not None:
                break
            finished = frame.finished_number(encoded)
        size += len(encoded)
        count += 1
    taken = pending[:count]
    del pending[:count]
    return taken, finished
