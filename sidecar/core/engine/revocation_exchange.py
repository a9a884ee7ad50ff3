"""Passes revocation lists on from sidecar to sidecar, so that a dead control plane withholds none.

A sidecar tells each peer that comes within reach the numbers of the lists it holds, and all peers when its lists
change: a few dozen bytes. A sidecar with an older list asks, one peer after the other, and is sent what there is.
Nothing is sent unasked, so that lists that a control plane passes to a whole fleet do not travel a second time over
every path. Nothing is taken except as the answer to a question: a lying member costs one question and one look at its
answer, each time with twice the pause before the next.

What arrives is PEM that nobody has judged yet. The CA's signature is checked outside; all lists that are accepted come
back in through `set_own`.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import islice
from typing import TYPE_CHECKING, TypeVar

from plr.sidecar.core.base.timers import NEVER
from plr.sidecar.core.base.values import Priority
from plr.sidecar.core.wire.messages import RevocationLists, RevocationsHeld, RevocationsWanted, encode_message

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from plr.protos.model.ids import NodeName
    from plr.sidecar.core.message.outbound import OutboundMessage
    from plr.sidecar.core.seam.stats import EngineStats
    from plr.sidecar.core.transfer.outbox import Outbox
    from plr.sidecar.core.transfer.routes import Routes
    from plr.sidecar.core.wire.messages import Encoded, RevocationMessage

ASK_AFTER_S = 0.5
"""Time between hearing of a newer list and asking for it: the control plane's own copy may be on its way."""
ASK_NEXT_AFTER_S = 5.0
"""Least time between two questions, to any peers: a list of thousands of entries takes as long over a slow path."""
ASK_AGAIN_S = 30.0
"""Time before the same peer is asked again, doubled each time that it was of no use."""
MAX_ASK_AGAIN_S = 3600.0
MAX_DOUBLINGS = 16
AWAIT_S = 120.0
"""Time for which a list is taken from a peer that we asked."""
SEND_AGAIN_S = 20.0
"""Time before a peer is sent the same lists again, doubled each time: less than it waits before it asks again."""
MAX_EXCHANGE_PEERS = 4096
"""Peers whose holdings, questions and sendings are remembered, also after their session ends: a peer that restarts
often must not be asked, or sent to, more often. As many as there can be peers; the one known longest is forgotten."""
MAX_SENDING_BYTES = 4 * 1024 * 1024
"""Most bytes of lists under way to all peers together; peers that ask beyond that wait for their turn."""
TOLD_AT_ONCE = 64
"""Peers told about our lists in one turn, which holds the engine's lock: less than a millisecond."""
TELL_EVERY_S = 0.01
"""Interval of such turns: 4,096 peers are told in under a second."""
LIFETIME_S = 120.0
"""Lifetime of a message on its way."""
EXCHANGES = ("asked", "sent", "received", "taken")
"""The keys of `EngineStats.revocations`."""

K = TypeVar("K")


@dataclass(slots=True)
class _Source:
    """The lists a peer says it holds, and how often we asked it in vain."""

    numbers: Mapping[int, int] = field(default_factory=dict)
    asked: int = 0
    ask_at: float = 0.0
    await_until: float = -NEVER


@dataclass(slots=True)
class _Sent:
    """The lists a peer was sent."""

    version: int = -1
    times: int = 0
    again_at: float = 0.0


class RevocationExchange:
    """Tells, asks and sends; the engine's peers feed it, and no table has more entries than there can be peers."""

    def __init__(self, routes: Routes, outbox: Outbox, stats: EngineStats) -> None:
        self._routes = routes
        self._outbox = outbox
        self._stats = stats
        self._own: Mapping[int, int] = {}
        """CA -> number of its newest list, for each CA that is trusted here; -1: there is none."""
        self._lists: bytes = b""
        self._version = 0
        """Number of times our lists have changed."""
        self._sources: dict[NodeName, _Source] = {}
        self._sent: dict[NodeName, _Sent] = {}
        self._untold: dict[NodeName, None] = {}
        self._waiting: dict[NodeName, None] = {}
        """Peers that asked and were not sent any lists yet."""
        self._sending: list[OutboundMessage] = []
        self._tell_at = NEVER
        self._ask_at = NEVER
        self._arrived: list[tuple[NodeName, bytes]] = []

    # -- from outside ---------------------------------------------------------------------------------------------

    def set_own(self, numbers: Mapping[int, int], pem: bytes, now: float) -> None:
        """Replace the lists we hold, all of them judged; `numbers` by CA, -1 for one that has none.

        `pem` is empty if they are too long to pass on.
        """
        if dict(numbers) == self._own:
            return
        self._own, self._lists = dict(numbers), pem
        self._version += 1
        for source in self._sources.values():
            if not self._is_newer(source):
                source.asked, source.ask_at = 0, 0.0
        if pem:
            self._untold.update(dict.fromkeys(self._routes.reached()))
            self._tell_at = now
        self._ask_at = self._next_question(now)

    def on_judged(self, peer: NodeName, now: float, *, good: bool) -> None:
        """Note that this peer's lists were accepted (and come through `set_own`), or are no lists of our CAs."""
        if good:
            self._stats.revocations["taken"] += 1
            return
        self._stats.dropped["revocations_refused"] += 1
        source = self._sources.get(peer)
        if source is not None:
            source.asked, source.ask_at = MAX_DOUBLINGS, now + MAX_ASK_AGAIN_S

    def take_arrived(self) -> list[tuple[NodeName, bytes]]:
        """Return the peers that sent lists since the last call, each with its PEM, which is to be judged."""
        arrived, self._arrived = self._arrived, []
        return arrived

    # -- from the engine ------------------------------------------------------------------------------------------

    def on_reached(self, peer: NodeName, now: float) -> None:
        """Tell a peer that came within reach about our lists."""
        if not self._lists:
            return
        self._untold[peer] = None
        self._tell_at = min(self._tell_at, now)

    def forget_peer(self, peer: NodeName) -> None:
        """Forget what belongs to a peer's session that is over."""
        self._untold.pop(peer, None)
        self._waiting.pop(peer, None)
        source = self._sources.get(peer)
        if source is not None:
            source.numbers, source.await_until = {}, -NEVER

    def on_message(self, peer: NodeName, message: RevocationMessage, now: float) -> None:
        """Take a peer's message."""
        match message:
            case RevocationsHeld(numbers):
                source = _kept(self._sources, peer, _Source)
                source.numbers = numbers
                if self._is_newer(source):
                    self._ask_at = min(self._ask_at, max(now + ASK_AFTER_S, source.ask_at))
            case RevocationsWanted(numbers):
                self._on_wanted(peer, numbers, now)
            case RevocationLists(pem):
                self._on_lists(peer, pem, now)

    def next_timer(self) -> float:
        """Return when to call `handle_timer` next."""
        return min(self._tell_at, self._ask_at)

    def handle_timer(self, now: float) -> None:
        """Do what is due now."""
        if now >= self._tell_at:
            self._tell(now)
        if now >= self._ask_at:
            self._ask(now)

    def on_room(self, now: float) -> None:
        """Send waiting lists, since less is under way than before."""
        if self._waiting:
            self._send_lists(now)

    # -- telling --------------------------------------------------------------------------------------------------

    def _tell(self, now: float) -> None:
        for peer in list(islice(self._untold, TOLD_AT_ONCE)):
            del self._untold[peer]
            self._send(peer, encode_message(RevocationsHeld(self._held())), now)
        self._tell_at = now + TELL_EVERY_S if self._untold else NEVER

    def _held(self) -> dict[int, int]:
        return {ca: number for ca, number in self._own.items() if number >= 0}

    # -- asking ---------------------------------------------------------------------------------------------------

    def _is_newer(self, source: _Source) -> bool:
        return any(number < source.numbers.get(ca, -1) for ca, number in self._own.items())

    def _next_question(self, now: float) -> float:
        times = [source.ask_at for source in self._sources.values() if self._is_newer(source)]
        return max(now, min(times)) if times else NEVER

    def _ask(self, now: float) -> None:
        """Ask the peer that we have asked in vain least often."""
        ready = [
            (source.asked, source.ask_at, peer)
            for peer, source in self._sources.items()
            if source.ask_at <= now and self._is_newer(source) and self._routes.reaches(peer)
        ]
        if ready:
            peer = min(ready)[2]
            source = self._sources[peer]
            source.ask_at = now + min(ASK_AGAIN_S * 2**source.asked, MAX_ASK_AGAIN_S)
            source.asked = min(source.asked + 1, MAX_DOUBLINGS)
            source.await_until = now + AWAIT_S
            self._stats.revocations["asked"] += 1
            self._send(peer, encode_message(RevocationsWanted(self._held())), now)
        self._ask_at = max(self._next_question(now), now + ASK_NEXT_AFTER_S)

    def _on_lists(self, peer: NodeName, pem: bytes, now: float) -> None:
        source = self._sources.get(peer)
        if source is None or source.await_until < now:
            self._stats.dropped["revocations_unasked"] += 1
            return
        source.await_until = -NEVER
        self._stats.revocations["received"] += 1
        self._arrived.append((peer, pem))

    # -- sending --------------------------------------------------------------------------------------------------

    def _on_wanted(self, peer: NodeName, numbers: Mapping[int, int], now: float) -> None:
        if not self._lists or all(number <= numbers.get(ca, -1) for ca, number in self._own.items()):
            return  # it has them already
        sent = _kept(self._sent, peer, _Sent)
        if sent.version == self._version and now < sent.again_at:
            self._stats.dropped["revocations_asked_too_often"] += 1
            return
        self._waiting[peer] = None
        self._send_lists(now)

    def _send_lists(self, now: float) -> None:
        self._sending = [message for message in self._sending if not message.newest.over]
        room = MAX_SENDING_BYTES - sum(message.symbols.total for message in self._sending)
        content = encode_message(RevocationLists(self._lists))
        for peer in list(self._waiting):
            if room < content.size:
                return
            del self._waiting[peer]
            message = self._send(peer, content, now)
            if message is not None:
                room -= content.size
                self._sending.append(message)
                self._stats.revocations["sent"] += 1
                self._note_sent(peer, now)

    def _note_sent(self, peer: NodeName, now: float) -> None:
        sent = _kept(self._sent, peer, _Sent)
        if sent.version != self._version:
            sent.version, sent.times = self._version, 0
        sent.again_at = now + min(SEND_AGAIN_S * 2**sent.times, MAX_ASK_AGAIN_S)
        sent.times = min(sent.times + 1, MAX_DOUBLINGS)

    def _send(self, peer: NodeName, content: Encoded, now: float) -> OutboundMessage | None:
        path = self._routes.best_to(peer)
        if path is None or not self._outbox.admits(peer, content.size):
            return None  # when there is one, the peer is told and asked again
        ends_at = now + LIFETIME_S
        return self._outbox.send(path, content, priority=Priority.LOW, deadline=ends_at, expires=ends_at)


def _kept(table: dict[NodeName, K], peer: NodeName, new: Callable[[], K]) -> K:
    """Return the peer's entry, created in place of the oldest one if the table is full."""
    if peer not in table:
        if len(table) >= MAX_EXCHANGE_PEERS:
            del table[next(iter(table))]
        table[peer] = new()
    return table[peer]
