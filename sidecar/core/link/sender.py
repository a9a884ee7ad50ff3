"""Builds one interface's datagrams from what its paths owe, their probes and their queued symbols."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, NamedTuple

from plr.protos.model.ids import Role
from plr.protos.trust.pair_token import pair_token
from plr.sidecar.core.base.timers import NEVER
from plr.sidecar.core.base.values import PathState
from plr.sidecar.core.crypto.aead import TAG_BYTES
from plr.sidecar.core.path.address import LEAST_CREDIT_BYTES
from plr.sidecar.core.wire import frame
from plr.sidecar.core.wire.frame import (
    BASE_FRAMES_BYTES,
    CLEAR,
    FRAGMENT_DATAGRAM_BYTES,
    FRAGMENT_OVERHEAD_BYTES,
    FRAGMENT_TYPE,
    HEADER_BYTES,
    MAX_LEFT_US,
    NONCE_OFFSET,
    REPAIR_TYPE,
    Header,
)
from plr.sidecar.core.wire.introduction import INTRODUCTION_BYTES, encode_introduction

if TYPE_CHECKING:
    from plr.protos.model.ids import Address, InterfaceId, InterfaceName, NodeName, SessionId
    from plr.protos.trust.credential import SessionCredential
    from plr.sidecar.core.message.symbols import MessageSymbols
    from plr.sidecar.core.path.path import Path
    from plr.sidecar.core.path.turn import SymbolRun
    from plr.sidecar.core.seam.stats import LinkStats

BURST_DATAGRAMS = 64
"""Datagrams built in one go before the driver looks at the socket again (about 70 kB, some milliseconds)."""

MTU_PROBE_TIMEOUTS = 3
"""A path MTU probe is given up after this many of the path's probe timeouts, if that is longer than its own limit."""

MAX_RUNS_IN_FLIGHT = 1024
"""With this many runs unacknowledged, FINISHED is sent without remembering it: no window holds it back, and a peer that
finishes messages but acknowledges nothing would fill the memory. If it is lost then, it is sent again when the peer
asks."""
MAX_BATCH_DATAGRAMS = 64
"""Segments that every kernel's offload takes (UDP_MAX_SEGMENTS of Linux before 6.10)."""
MAX_BATCH_BYTES = 65_000
"""The largest UDP payload, less a margin."""


@dataclass(frozen=True, slots=True)
class LinkIdentity:
    """Our identity on this interface."""

    interface: InterfaceName
    interface_id: InterfaceId
    name: NodeName
    role: Role
    session: SessionId
    token: bytes = field(repr=False)
    """Our own token; each peer knows the one derived from it for that peer (`protos/trust/pair_token.py`)."""
    credential: bytes = field(repr=False)
    """Encoded."""

    @classmethod
    def of(
        cls, credential: SessionCredential, token: bytes, interface: InterfaceName, interface_id: InterfaceId
    ) -> LinkIdentity:
        """Return the identity of a credential's owner on this interface."""
        name, role, session = credential.name, credential.role, credential.session
        return cls(interface, interface_id, name, role, session, token, credential.encode())


class Batch(NamedTuple):
    """Contiguous datagrams to one address: at most MAX_BATCH_DATAGRAMS and MAX_BATCH_BYTES."""

    address: Address
    data: bytes | bytearray | memoryview
    segment: int
    """Bytes of each datagram; the last may be shorter."""

    @property
    def datagrams(self) -> int:
        """Number of datagrams."""
        return -(-len(self.data) // self.segment)

    def cut(self) -> list[memoryview]:
        """Return the datagrams one by one."""
        view = memoryview(self.data)
        return [view[start : start + self.segment] for start in range(0, len(view), self.segment)]


class Burst:
    """Batches that leave together."""

    __slots__ = ("batches", "datagrams")

    def __init__(self) -> None:
        self.batches: list[Batch] = []
        self.datagrams = 0

    @property
    def full(self) -> bool:
        """Whether the driver shall look at the socket again before more is built."""
        return self.datagrams >= BURST_DATAGRAMS

    def add(self, address: Address, data: bytes | bytearray, segment: int, count: int = 1) -> None:
        """Add `count` datagrams as in a Batch; they join the previous batch if they fit."""
        self.datagrams += count
        if self.batches:
            before = self.batches[-1]
            joined, size = before.data, before.segment
            if (
                segment == size
                and before.address == address
                and isinstance(joined, bytearray)
                and len(joined) + len(data) <= min(MAX_BATCH_BYTES, MAX_BATCH_DATAGRAMS * size)
                and len(joined) % size == 0
            ):
                joined += data
                return
        self.batches.append(Batch(address, data, segment))


class DatagramBuilder:
    """Turns the state of a link's paths into datagrams, and notes in it what left."""

    __slots__ = ("_stats", "identity")

    def __init__(self, identity: LinkIdentity, stats: LinkStats) -> None:
        self.identity = identity
        self._stats = stats

    def build(self, path: Path, burst: Burst, now: float, *, probing: bool) -> bool:
        """Add what the path may send now; return False if the burst got full first. `probing` allows probes."""
        if path.introductions.waiting:
            self._answer_introductions(path, burst, now)
        if path.state is PathState.DOWN and path.control_at <= now:
            # Answers go before our own questions: both count against what may go to an unproven address.
            self._add_control(path, path.take_control(now), burst, now)
        if probing and path.probe_at <= now:
            self._add_probe(path, burst, now)
        if probing and (mtu_probe_at := path.mtu_probe_at) is not None and mtu_probe_at <= now:
            self._add_mtu_probe(path, burst, now)
        if path.pings:
            self._add_pings(path, burst, now)
        complete = self._add_fragments(path, burst, now)
        if path.control_at <= now:
            self._add_control(path, path.take_control(now), burst, now)
        return complete

    def _add_fragments(self, path: Path, burst: Burst, now: float) -> bool:
        queue = path.queue
        remote = path.remote
        if not len(queue) or path.state is PathState.DOWN or remote is None:
            return True
        recovery, control, address = path.recovery, path.control, path.address
        expired_before = queue.expired
        complete = True
        budget = control.budget(now, recovery.in_flight)
        while budget > 0 and len(queue):
            if burst.full:
                complete = False
                break
            allowance = address.allowance
            if allowance is not None:
                if path.control_at < NEVER:
                    self._add_control(path, path.take_control(now), burst, now)
                    allowance = address.allowance
                budget = budget if allowance is None else min(budget, allowance)
            pulls, pace = path.state is PathState.UP, control.pacing_rate
            # Repeats must not stand in a queue, where what is needed would wait behind them.
            repeats = pace is None or recovery.in_flight < pace * recovery.rtt.minimum
            run = queue.take(now, budget, pace or 0.0, recovery.rtt.smoothed, pulls=pulls, repeats=repeats)
            if run is None:
                control.ran_dry()
                break
            if allowance is not None and run.symbols * run.message.datagram_bytes > allowance:
                # Wait until the peer has proven to be there, or sent more from there.
                queue.resend(run.message, range(run.first, run.first + run.symbols))
                address.block()
                control.ran_dry()
                break
            sent = self._add_run(path, remote, run, burst, now)
            control.on_sent(now, sent, recovery.in_flight)
            budget -= sent
        if not len(queue):
            control.ran_dry()  # also when the last run used up the budget: nothing looks at an empty queue again
        if queue.expired != expired_before:
            self._stats.dropped["expired"] += queue.expired - expired_before
        return complete

    def _add_run(self, path: Path, remote: Address, run: SymbolRun, burst: Burst, now: float) -> int:
        """Add a run's datagrams and return their bytes. Waiting control frames go with it or before it."""
        end, sources = run.first + run.symbols, run.message.count
        path.waits_for_answer(now)
        path.probing.used(now)
        if path.control_at < NEVER:
            control = path.take_control(now)
            size = run.message.datagram_bytes + sum(map(len, control))
            if run.symbols == 1 and size <= path.mtu.size and len(control) < frame.MAX_FRAMES:
                return self._add_with_control(path, remote, control, run, burst, now)
            self._add_control(path, control, burst, now)
        if run.first < sources < end:  # the last source symbol may be shorter than what follows
            head = self._add_symbols(path, remote, run, range(run.first, sources), burst, now)
            return head + self._add_symbols(path, remote, run, range(sources, end), burst, now)
        return self._add_symbols(path, remote, run, range(run.first, end), burst, now)

    def _add_symbols(
        self, path: Path, remote: Address, run: SymbolRun, indices: range, burst: Burst, now: float
    ) -> int:
        """Build a datagram for each symbol, all but the last equally long, and seal each in place."""
        message, count = run.message, len(indices)
        symbol, message_number, total = message.symbol, message.number, message.total
        left_us = _left_us(path, message, now)
        segment = FRAGMENT_OVERHEAD_BYTES + symbol
        first_number = path.recovery.take_numbers(count)
        sealing = path.sealing
        sealing.sealed += count
        head, seal_into = sealing.head, sealing.encrypt_into
        session = self.identity.session
        kind = FRAGMENT_TYPE if indices.start < message.count else REPAIR_TYPE
        self._stats.datagrams["sent", _counted(run, indices.start)] += count
        pack, symbol_data = frame.FRAGMENT_DATAGRAM.pack_into, message.symbol_data
        buffer = bytearray(segment * count)
        end = 0
        with memoryview(buffer) as view:
            for number, index in enumerate(indices, first_number):
                pack(buffer, end, head, session, number, kind, message_number, total, symbol, index, left_us)
                data = symbol_data(index)
                start, body = end, end + HEADER_BYTES
                plain_end = start + FRAGMENT_DATAGRAM_BYTES + len(data)
                end = plain_end + TAG_BYTES
                view[start + FRAGMENT_DATAGRAM_BYTES : plain_end] = data
                seal_into(view[start + NONCE_OFFSET : body], view[body:plain_end], view[start:body], view[body:end])
        if message.over:
            return 0  # whoever ended it meanwhile relies on nothing having left; numbers may be skipped
        del buffer[end:]
        last = end - segment * (count - 1)
        path.recovery.on_run_sent(first_number, count, now, segment, last, message, indices.start)
        burst.add(remote, buffer, segment if count > 1 else last, count)
        self._sent(path, remote, end)
        return end

    def _add_with_control(
        self, path: Path, remote: Address, control: list[bytes], run: SymbolRun, burst: Burst, now: float
    ) -> int:
        """Build one datagram of control frames and a symbol, such as a small answer and what its request is owed."""
        message, index = run.message, run.first
        number = path.recovery.take_numbers()
        left_us = _left_us(path, message, now)
        head = frame.encode_fragment_head(message.number, message.total, message.symbol, index, left_us)
        symbol = message.symbol_data(index)
        if message.over:  # as in `_add_symbols`
            self._add_control(path, control, burst, now)
            return 0
        datagram = self._sealed(path, number, now, *control, head, symbol)
        size = len(datagram)
        path.recovery.on_run_sent(number, 1, now, size, size, message, index, _finished(control))
        self._stats.datagrams["sent", _counted(run, index)] += 1
        burst.add(remote, datagram, size)
        self._sent(path, remote, size)
        return size

    def _sent(self, path: Path, address: Address, size: int) -> None:
        path.sent(address, size)
        self._stats.bytes["sent"] += size

    def _add_control(self, path: Path, control: list[bytes], burst: Burst, now: float) -> None:
        if path.remote is None:
            return
        while control:
            allowance = path.address.allowance
            taken = _fill(control, None if allowance is None else allowance - HEADER_BYTES - TAG_BYTES)
            if not taken:
                path.address.block()
                if over := path.owed.put_back(control, now):
                    self._stats.dropped["pending_frames_full"] += over
                return
            finished = _finished(taken)
            number = path.recovery.take_numbers()
            datagram = self._sealed(path, number, now, *taken)
            if finished and len(path.recovery.sent) < MAX_RUNS_IN_FLIGHT:
                path.recovery.on_finished_sent(number, now, len(datagram), finished)
                path.waits_for_answer(now)
            elif finished:
                self._stats.dropped["finished_unwatched"] += len(finished)
            self._add_alone(path, path.remote, datagram, burst)

    def _add_probe(self, path: Path, burst: Burst, now: float) -> None:
        remote = path.remote
        # Each destination has its own probe: the answer tells at which one the peer is.
        if remote is not None and path.goes_to_one:
            asked = [frame.encode_probe(frame.Probe(path.ask(now, remote)))]
            if (offer := path.offer_keys(now)) is not None:
                asked.append(frame.encode_key_offer(offer))
            self._add_control(path, [*asked, *path.take_control(now)], burst, now)
            if path.renewed_at is not None and path.address.is_proven:
                self._add_introduction(path, remote, path.probing.ask(now, remote, sealed=False), burst, now)
        elif path.state is PathState.DOWN:
            for address in path.destinations(now, INTRODUCTION_BYTES + len(self.identity.credential)):
                self._add_introduction(path, address, path.ask(now, address), burst, now)
        else:
            for address in path.destinations(now, LEAST_CREDIT_BYTES):
                probe = frame.encode_probe(frame.Probe(path.ask(now, address)))
                self._add_alone(path, address, self._sealed(path, path.recovery.take_numbers(), now, probe), burst)
        path.plan_probe(now)

    def _add_introduction(self, path: Path, address: Address, probe_id: int, burst: Burst, now: float) -> None:
        me = self.identity
        header = Header(me.interface_id, path.remote_id, me.session, path.recovery.take_numbers())
        token = pair_token(me.token, path.peer, Role.CLOUD if me.role is Role.ROBOT else Role.ROBOT)
        offer = path.offer_keys(now)
        datagram = encode_introduction(header, token, path.peer, probe_id, me.credential, offer)
        self._add_alone(path, address, datagram, burst)

    def _answer_introductions(self, path: Path, burst: Burst, now: float) -> None:
        """Answer each introduction at its source, and ask back: the reply proves who it was, and moves the path."""
        for address, probe_id, answer in path.introductions.take():
            frames = [
                frame.encode_probe_reply(frame.ProbeReply(probe_id)),
                frame.encode_probe(frame.Probe(path.probing.ask_back(now, address))),
            ]
            if answer is not None:
                frames.append(frame.encode_key_answer(answer))
            elif (offer := path.offer_keys(now)) is not None:
                frames.append(frame.encode_key_offer(offer))
            datagram = self._sealed(path, path.recovery.take_numbers(), now, *frames)
            self._add_alone(path, address, datagram, burst)

    def _add_mtu_probe(self, path: Path, burst: Burst, now: float) -> None:
        """Add a padded probe. Nobody waits for its acknowledgement, and its loss says nothing of other datagrams."""
        probe_id = path.probing.take_id()
        size = path.mtu.next_probe(probe_id, now, MTU_PROBE_TIMEOUTS * path.recovery.rtt.probe_timeout(0.0))
        if size is None or path.remote is None:
            return
        probe = frame.encode_probe(frame.Probe(probe_id))
        padding = frame.encode_padding(size - HEADER_BYTES - len(probe) - TAG_BYTES)
        datagram = self._sealed(path, path.recovery.take_numbers(), now, probe, padding)
        self._add_alone(path, path.remote, datagram, burst)

    def _add_pings(self, path: Path, burst: Burst, now: float) -> None:
        """Add the waiting pings, as `_add_mtu_probe` does; drop those of a path that has just gone down."""
        pings = path.take_pings()
        if path.state is PathState.DOWN or path.remote is None:
            return
        for ping in pings:
            ping.sent_at = now
            probe = frame.encode_probe(frame.Probe(ping.id))
            padding = frame.encode_padding(max(0, ping.size - HEADER_BYTES - len(probe) - TAG_BYTES))
            datagram = self._sealed(path, path.recovery.take_numbers(), now, probe, padding)
            self._add_alone(path, path.remote, datagram, burst)

    def _add_alone(self, path: Path, address: Address, datagram: bytes, burst: Burst) -> None:
        burst.add(address, datagram, len(datagram))
        self._stats.datagrams["sent", "control"] += 1
        self._sent(path, address, len(datagram))

    def _sealed(self, path: Path, number: int, now: float, *frames: bytes | memoryview) -> bytes:
        """Return a datagram of these encoded frames."""
        sealing = path.sealing
        sealing.sealed += 1
        clear = CLEAR.pack(sealing.head, self.identity.session, number)
        plain = b"".join(frames)
        sealed = bytearray(len(plain) + TAG_BYTES)
        sealing.encrypt_into(clear[NONCE_OFFSET:], plain, clear, sealed)
        return clear + sealed


def _counted(run: SymbolRun, index: int) -> str:
    """Return the kind as which its symbols from this one on are counted."""
    if run.repeats:
        return "repeat"
    return "data" if index < run.message.count else "repair"


def _left_us(path: Path, message: MessageSymbols, now: float) -> int:
    """Return how long the message will be of use on arrival.

    One way counts as half a round trip. If that is too much, the way back is longer, and the answer would come no
    sooner.
    """
    left_s = message.expires - now - path.recovery.rtt.smoothed / 2
    return min(max(0, int(left_s * 1e6)), MAX_LEFT_US) if left_s < NEVER else MAX_LEFT_US


def _fill(control: list[bytes], allowance: int | None) -> list[bytes]:
    """Take the frames of one datagram from `control`; none if the first already exceeds `allowance` (bytes)."""
    size = 0
    count = 0
    limit = BASE_FRAMES_BYTES if allowance is None else min(allowance, BASE_FRAMES_BYTES)
    for encoded in control:
        if size + len(encoded) > limit or count == frame.MAX_FRAMES:
            break
        size += len(encoded)
        count += 1
    taken = control[:count]
    del control[:count]
    return taken


def _finished(control: list[bytes]) -> tuple[int, ...]:
    """Return the messages that these frames report FINISHED."""
    return tuple(frame.finished_number(encoded) for encoded in control if encoded[0] == frame.FINISHED_TYPE)
