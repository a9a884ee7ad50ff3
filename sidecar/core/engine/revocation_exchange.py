"""Passes revocation lists on from sidecar to sidecar, so that a dead control plane withholds none.

Who holds which lists is told by their numbers, whenever a peer comes within reach or we have others: a few dozen bytes.
Who has an older one asks, one peer after the other, and is sent what there is. Nothing is sent to who did not ask, so
that the lists that a control plane passes to a whole fleet do not travel a second time over every path, and nothing is
taken but as the answer to a question: what a member that tells tales costs is one question, and one look at what it
answers, each time with twice the pause before the next.

What comes is PEM that nobody has judged yet. The CA's signature is looked at outside, where everything that is taken
comes back in by `set_own`.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import islice
from typing import TYPE_CHECKING, TypeVar

from sidecar.core.base.values import Priority
from sidecar.core.wire.messages import RevocationLists, RevocationsHeld, RevocationsWanted, encode_message

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from protos.model.ids import NodeName
    from sidecar.core.message.outbound import OutboundMessage
    from sidecar.core.seam.stats import EngineStats
    from sidecar.core.transfer.outbox import Outbox
    from sidecar.core.transfer.routes import Routes
    from sidecar.core.wire.messages import Encoded, RevocationMessage

ASK_AFTER_S = 0.5
"""From hearing of a newer list until we ask for it: the control plane's own copy may be on its way."""
ASK_NEXT_AFTER_S = 5.0
"""Between two questions, whomever they go to: a list of thousands of entries takes as long over a slow path."""
ASK_AGAIN_S = 30.0
"""Before the same peer is asked again, twice as long each time that it was of no use."""
MAX_ASK_AGAIN_S = 3600.0
MAX_DOUBLINGS = 16
AWAIT_S = 120.0
"""A list is taken from whom we asked, for so long."""
SEND_AGAIN_S = 20.0
"""Before a peer is sent the same lists again, twice as long each time: less than it waits before it asks again."""
MAX_REMEMBERED = 4096
"""Peers of which is known what they hold, were asked and sent, also beyond a session's end: who restarts often shall
not be asked, or sent to, more often. As many as there can be peers; whoever has been known longest is forgotten."""
MAX_SENDING_BYTES = 4 * 1024 * 1024
"""Lists under way to all peers together; who asked beyond that waits for its turn."""
TOLD_AT_ONCE = 64
"""Peers told of our lists in one turn, which has the engine's lock: less than a millisecond."""
TELL_EVERY_S = 0.01
"""Between two such turns: 4,096 peers are told in under a second."""
LIFETIME_S = 120.0
"""Of a message on its way."""
EXCHANGES = ("asked", "sent", "received", "taken")
"""The keys of `EngineStats.revocations`."""
NEVER = float("inf")

K = TypeVar("K")


@dataclass(slots=True)
class _Source:
    """What a peer says it holds, and how often we asked it in vain."""

    numbers: Mapping[int, int] = field(default_factory=dict)
    asked: int = 0
    ask_at: float = 0.0
    await_until: float = -NEVER


@dataclass(slots=True)
class _Sent:
    """What a peer was sent."""

    version: int = -1
    times: int = 0
    again_at: float = 0.0


class RevocationExchange:
    """What is told, asked and sent; the engine's peers feed it, and every table has at most as many entries."""

    def __init__(self, routes: Routes, outbox: Outbox, stats: EngineStats) -> None:
        self._routes = routes
        self._outbox = outbox
        self._stats = stats
        self._own: Mapping[int, int] = {}
        """Number of the newest list by CA, for each CA that is believed here; -1: there is none."""
        self._lists: bytes = b""
        self._version = 0
        """Counts our changes of lists."""
        self._sources: dict[NodeName, _Source] = {}
        self._sent: dict[NodeName, _Sent] = {}
        self._untold: dict[NodeName, None] = {}
        self._waiting: dict[NodeName, None] = {}
        """Who asked and was not sent any yet."""
        self._sending: list[OutboundMessage] = []
        self._tell_at = NEVER
        self._ask_at = NEVER
        self._arrived: list[tuple[NodeName, bytes]] = []

    # -- from outside ---------------------------------------------------------------------------------------------

    def set_own(self, numbers: Mapping[int, int], pem: bytes, now: float) -> None:
        """We hold these lists now, all of them judged; `numbers` by CA, -1 for one that has none.

        `pem`: empty where they are too long to pass on.
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
        """What this peer sent is taken (and comes by `set_own`), or is no list of our CAs."""
        if good:
            self._stats.revocations["taken"] += 1
            return
        self._stats.dropped["revocations_refused"] += 1
        source = self._sources.get(peer)
        if source is not None:
            source.asked, source.ask_at = MAX_DOUBLINGS, now + MAX_ASK_AGAIN_S

    def take_arrived(self) -> list[tuple[NodeName, bytes]]:
        """Return what peers sent since the last call, PEM that is to be judged, and who did."""
        arrived, self._arrived = self._arrived, []
        return arrived

    # -- from the engine ------------------------------------------------------------------------------------------

    def on_reached(self, peer: NodeName, now: float) -> None:
        """There is a path to a peer."""
        if not self._lists:
            return
        self._untold[peer] = None
        self._tell_at = min(self._tell_at, now)

    def forget_peer(self, peer: NodeName) -> None:
        """The peer's session is over."""
        self._untold.pop(peer, None)
        self._waiting.pop(peer, None)
        source = self._sources.get(peer)
        if source is not None:
            source.numbers, source.await_until = {}, -NEVER

    def on_message(self, peer: NodeName, message: RevocationMessage, now: float) -> None:
        """Take what a peer says."""
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
        """When `handle_timer` is wanted next."""
        return min(self._tell_at, self._ask_at)

    def handle_timer(self, now: float) -> None:
        """Do what is due by now."""
        if now >= self._tell_at:
            self._tell(now)
        if now >= self._ask_at:
            self._ask(now)

    def on_room(self, now: float) -> None:
        """Less is under way than before."""
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
        """Ask whom we asked in vain the least."""
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
            return  # it has them by now
        sent = _kept(self._sent, peer, _Sent)
        if sent.version == self._version and now < sent.again_at:
            self._stats.dropped["revocations_asked_too_often"] += 1
            return
        self._waiting[peer] = None
        self._send_lists(now)

    def _send_lists(self, now: float) -> None:
        self._sending = [message for message in self._sending if not message.newest.over]
        room = MAX_SENDING_BYTES - sum(message.total for message in self._sending)
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
        if path is None:
            return None  # when there is one, the peer is told, and asked, again
        ends_at = now + LIFETIME_S
        return self._outbox.send(path, content, priority=Priority.LOW, deadline=ends_at, expires=ends_at)


def _kept(table: dict[NodeName, K], peer: NodeName, new: Callable[[], K]) -> K:
    """Return the peer's entry, which may be a new one in place of the oldest."""
    if peer not in table:
        if len(table) >= MAX_REMEMBERED:
            del table[next(iter(table))]
        table[peer] = new()
    return table[peer]
