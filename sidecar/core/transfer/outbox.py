"""Keeps undelivered messages, and decides over which path their missing symbols travel."""

from __future__ import annotations

from functools import partial
from itertools import islice
from typing import TYPE_CHECKING

from plr.sidecar.core.base.slices import in_groups
from plr.sidecar.core.base.values import PathState
from plr.sidecar.core.message.outbound import OutboundMessage
from plr.sidecar.core.message.repair import repair_symbols, worth_a_copy
from plr.sidecar.core.message.symbols import MessageSymbols
from plr.sidecar.core.seam.links import FragmentsLost, Resend, Send, SendAbandon
from plr.sidecar.core.transfer.room import Room
from plr.sidecar.core.wire.frame import symbol_count

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from plr.protos.model.ids import InterfaceName, NodeName
    from plr.sidecar.core.base.slices import Step
    from plr.sidecar.core.base.values import PathId, Priority, RequestId
    from plr.sidecar.core.message.repair import Loss, Redundancy
    from plr.sidecar.core.message.sharing import Sharing
    from plr.sidecar.core.seam.links import PathCommand
    from plr.sidecar.core.seam.stats import EngineStats
    from plr.sidecar.core.transfer.routes import Routes
    from plr.sidecar.core.wire.messages import Encoded

LOOKED_AT_ONCE = 512
"""Messages that one call of `ask_again` looks at, under the engine's lock: about a millisecond."""
MAX_GENERATIONS = 8
"""How often a message is sent again under another number. Only a dishonest receiver forgets it more often."""


class Outbox:
    """Undelivered messages, by number. The numbers are this session's own, never reused."""

    def __init__(self, routes: Routes, command: Callable[[PathCommand], None], stats: EngineStats) -> None:
        self._routes = routes
        self._command = command
        self._stats = stats
        self._messages: dict[int, OutboundMessage] = {}
        self._by_peer: dict[NodeName, dict[int, OutboundMessage]] = {}
        self._parked: dict[NodeName, dict[int, OutboundMessage]] = {}
        self._room = Room()
        self._answers: dict[tuple[NodeName, RequestId], list[OutboundMessage]] = {}
        """Undelivered answers by robot and request: one for each copy that asked."""
        self._answers_over: list[tuple[NodeName, RequestId]] = []
        """Keys whose last message ended since `take_answers_over`; a message that is cut again starts over."""
        self._made_room = False
        self._looked_at = 0
        """Number of messages, oldest first, that `ask_again` has looked at in this round."""
        self._next_number = 1

    def __len__(self) -> int:
        return len(self._messages)

    @property
    def held_bytes(self) -> int:
        """Bytes of all undelivered messages."""
        return self._room.held_bytes

    def messages_to(self, peer: NodeName) -> int:
        """Return the number of undelivered messages to this peer."""
        return self._room.messages_to(peer)

    def sent_over(self, path: PathId) -> int:
        """Return the bytes of undelivered messages first sent over this path."""
        return self._room.sent_over(path)

    def waiting_over(self, interface: InterfaceName) -> int:
        """Return the number of undelivered messages that use this interface."""
        return sum(interface in message.interfaces for message in self._messages.values())

    def has_room(self, peer: NodeName, size: int) -> bool:
        """Return whether another message of this size may be sent to this peer."""
        return self._room.fits(peer, size)

    def admits(self, peer: NodeName, size: int) -> bool:
        """Return whether another message of this size may be sent to this peer; count it as left out if not."""
        fits = self._room.fits(peer, size)
        if not fits:
            self._stats.dropped["outbox_full"] += 1
        return fits

    def take_made_room(self) -> bool:
        """Return whether a message ended since the last call, so that what waits for room may find it."""
        made, self._made_room = self._made_room, False
        return made

    def take_answers_over(self) -> list[tuple[NodeName, RequestId]]:
        """Return the robots and requests whose answers are no longer under way, delivered or not."""
        over, self._answers_over = self._answers_over, []
        return [key for key in over if key not in self._answers]

    def carries_answer(self, peer: NodeName, request: RequestId) -> bool:
        """Return whether an answer to this request is under way."""
        return (peer, request) in self._answers

    def answer_has_begun(self, peer: NodeName, request: RequestId) -> bool:
        """Return whether some of an answer that is under way may have left."""
        return any(message.symbols.begun for message in self._answers.get((peer, request), ()))

    def send(
        self,
        path: PathId,
        content: Encoded,
        *,
        priority: Priority,
        deadline: float,
        expires: float,
        fec: Redundancy = None,
        answers: RequestId | None = None,
        copy_of: RequestId | None = None,
        siblings: list[MessageSymbols] | None = None,
        shared_by: Sequence[PathId] = (),
        repeats: float = 0.0,
    ) -> OutboundMessage:
        """Send a message over `path`, to a peer that has room for it: `has_room` and `admits` say which.

        `fec`: repair symbols for each source symbol, None: by the path's loss; none at all if they find no room.
        `answers`: the request that it answers, by which `drop_answers` finds it.
        `copy_of`: the request that it is a copy of.
        `siblings`: the messages that already carry the same request; it joins them.
        `shared_by`: further paths to the same peer that carry it together with `path`, and repeat the share `repeats`.
        """
        size, loss = content.size, self._routes.loss(path)
        symbol = self._routes.symbol_to(path.peer)
        count = symbol_count(size, symbol)
        repairs = repair_symbols(count, fec, loss)
        if repairs and not self._room.fits(path.peer, size, (count + repairs) * symbol):
            repairs = 0
        symbols = MessageSymbols(
            self._take_number(),
            content,
            priority=priority,
            deadline=deadline,
            expires=expires,
            symbol=symbol,
            repairs=repairs,
            siblings=siblings,
            repeats=repeats if shared_by else None,
        )
        message = OutboundMessage(path, symbols, answers=answers, copy_of=copy_of, shared_by=shared_by)
        self._enter(message, loss)
        return message

    def _take_number(self) -> int:
        number = self._next_number
        self._next_number += 1
        return number

    def _enter(self, message: OutboundMessage, loss: Loss) -> None:
        peer, number = message.path.peer, message.number
        self._messages[number] = message
        self._by_peer.setdefault(peer, {})[number] = message
        if message.answers is not None:
            self._answers.setdefault((peer, message.answers), []).append(message)
        self._room.take(message)
        symbols = message.symbols
        for path in message.carriers:
            self._command(Send(path, symbols))
        if not symbols.repairs and symbols.sharing is None and worth_a_copy(1, loss):
            # It leaves before the others, so a burst does not take both.
            self._send_copies(message, message.path, (symbols.count - 1,))

    def on_finished(self, peer: NodeName, number: int) -> OutboundMessage | None:
        """Remove a message that the peer holds; None if it is not one of the peer's messages, or was already over."""
        message = self._messages.get(number)
        if message is None or message.path.peer != peer:
            return None
        self._remove(message)
        return message

    def on_answered(self, message: OutboundMessage) -> None:
        """Remove a message whose answer proves that the peer holds it, even if its FINISHED got lost."""
        self._remove(message.newest)

    def on_forgotten(self, peer: NodeName, number: int) -> None:
        """Send a message again from the beginning, since the peer dropped what it had of it."""
        message = self._messages.get(number)
        if message is None or message.peer != peer:
            return
        self._stats.dropped["message_forgotten"] += 1
        self._remove(message)
        if message.generation < MAX_GENERATIONS:
            self._enter_again(message, self._routes.best_to(peer) or message.path)

    def drop(self, message: OutboundMessage) -> None:
        """Stop sending a message, in whatever it was cut into, and tell a peer that has some of it."""
        message = message.newest
        symbols = message.symbols
        unfinished = symbols.begun and not symbols.over and symbols.count > 1
        self._remove(message)
        if unfinished:
            path = self._routes.best_to(message.peer)
            if path is not None:
                self._command(SendAbandon(path, message.number))

    def _remove(self, message: OutboundMessage) -> None:
        message.end()
        if self._messages.pop(message.number, None) is not None:
            peer = message.path.peer
            of_peer = self._by_peer.get(peer, {})
            of_peer.pop(message.number, None)
            if not of_peer:
                self._by_peer.pop(peer, None)
            self._room.give_back(message)
            self._made_room = True
            self._parked.get(peer, {}).pop(message.number, None)
            if message.answers is not None:
                self._forget_answer((peer, message.answers), message)

    def drop_answers(self, peer: NodeName, request: RequestId) -> None:
        """Keep back what is unsent of the answers to this request, which the peer called off."""
        for message in self._answers.get((peer, request), ())[:]:
            self.drop(message)

    def _forget_answer(self, key: tuple[NodeName, RequestId], message: OutboundMessage) -> None:
        answers = self._answers[key]
        answers.remove(message)
        if not answers:
            del self._answers[key]
            self._answers_over.append(key)

    def drop_peer(self, peer: NodeName) -> list[Step]:
        """Drop what was meant for a peer whose session is over. Return the remaining steps."""
        messages = self._by_peer.pop(peer, {}).values()
        for message in messages:
            message.end()
        self._parked.pop(peer, None)
        return in_groups(self._remove, messages)

    def under_way(self, symbols: MessageSymbols) -> OutboundMessage | None:
        """Return the message that these are the symbols of; None if it is over."""
        message = None if symbols.over else self._messages.get(symbols.number)
        return message if message is not None and message.symbols is symbols else None

    def on_lost(self, event: FragmentsLost, now: float) -> None:
        """Send lost symbols again over the best path to that peer; without one, keep them until there is one."""
        message = self.under_way(event.message)
        if message is None:
            return
        if event.message.expires <= now:
            self.drop(message)
            return
        indices = message.lost(event.indices)
        if message.symbols.sharing is not None:
            indices = self._give_back(message, message.symbols.sharing, indices)
        if not indices:
            return
        path = self._routes.best_to(
            message.peer, avoid=event.path if event.timed_out else None, size=message.symbols.datagram_bytes
        )
        if path is None:
            self._parked.setdefault(message.peer, {})[message.number] = message
        else:
            self._resend(message, path, indices)

    def _give_back(self, message: OutboundMessage, sharing: Sharing, lost: tuple[int, ...]) -> tuple[int, ...]:
        """Let the paths that carry a message together take what got lost; return what none of them can."""
        size = message.symbols.datagram_bytes
        carriers = [path for path in message.carriers if self._routes.max_datagram(path) >= size]
        states = {path: self._routes.state(path) for path in carriers}
        if PathState.UP in states.values():
            sharing.give_back(lost)
            for path, state in states.items():
                if state is PathState.UP:
                    self._let_look(message, path)
            return ()
        if PathState.UNSTABLE in states.values():
            return lost  # what is untaken waits until one of them is up again
        return tuple(sorted({*lost, *sharing.take_all()}))

    def _let_look(self, message: OutboundMessage, path: PathId) -> None:
        message.interfaces.add(path.interface)
        self._command(Resend(path, message.symbols, ()))

    def _resend(self, message: OutboundMessage, path: PathId, indices: tuple[int, ...]) -> None:
        if message.symbols.datagram_bytes > self._routes.max_datagram(path):
            self._cut_again(message, path)
            return
        message.interfaces.add(path.interface)
        self._command(Resend(path, message.symbols, indices))
        if worth_a_copy(len(indices), self._routes.loss(path)):
            self._send_copies(message, self._routes.beside(path, message.symbols.datagram_bytes) or path, indices)

    def _send_copies(self, message: OutboundMessage, path: PathId, indices: tuple[int, ...]) -> None:
        message.interfaces.add(path.interface)
        message.copied(indices)
        self._command(Resend(path, message.symbols, indices))

    def _cut_again(self, message: OutboundMessage, path: PathId) -> None:
        """Send the whole message again in smaller symbols: no path carries its present ones any more."""
        self.drop(message)
        self._enter_again(message, path)

    def _enter_again(self, message: OutboundMessage, path: PathId) -> None:
        symbol = self._routes.symbol_to(path.peer)
        others = [other for other in message.carriers if other != path and self._routes.state(other) is PathState.UP]
        again = message.cut_again(self._take_number(), path, symbol, others)
        self._enter(again, self._routes.loss(path))

    def on_path_up(self, path: PathId) -> list[Step]:
        """Return the steps that send all that waited for a path to this peer, and let it share again what it shared."""
        parked = self._parked.pop(path.peer, {})
        shared = [
            message
            for number, message in self._by_peer.get(path.peer, {}).items()
            if message.symbols.sharing is not None and path in message.carriers and number not in parked
        ]
        waiting = [partial(self._send_rest, message) for message in parked.values()]
        return [*waiting, *in_groups(partial(self._let_look_again, path), shared)]

    def _let_look_again(self, path: PathId, message: OutboundMessage) -> None:
        sharing = message.symbols.sharing
        if not message.over and sharing is not None and sharing.untaken:
            self._let_look(message, path)

    def on_interface_gone(self, interface: InterfaceName) -> list[Step]:
        """Return the steps that move messages off an interface whose link is gone, with all it had queued.

        Their symbols in flight over another interface travel twice; nobody knows any more which those are.
        """
        messages = [message for message in self._messages.values() if interface in message.interfaces]
        for message in messages:
            message.interfaces.discard(interface)
        return [partial(self._send_rest, message) for message in messages]

    def _send_rest(self, message: OutboundMessage, now: float) -> None:
        """Send all that is missing of a message, even if in flight."""
        self.on_lost(FragmentsLost(message.path, message.symbols, message.give_up()), now)

    def ask_again(self) -> None:
        """Ask about messages that the peer seems to have in full, but has not reported FINISHED.

        That report gets lost if the interface on which it waited goes, for example. One symbol sent once more brings
        it. Call this about once a second: a message found so twice is asked about.
        """
        start = self._looked_at
        messages = list(islice(self._messages.values(), start, start + LOOKED_AT_ONCE))
        self._looked_at = start + LOOKED_AT_ONCE if len(messages) == LOOKED_AT_ONCE else 0
        for message in messages:
            if message.symbols.arrived < message.symbols.count:
                message.unreported = False
            elif not message.unreported:
                message.unreported = True
            elif (path := self._routes.best_to(message.peer, size=message.symbols.datagram_bytes)) is not None:
                message.symbols.ask_again()
                self._resend(message, path, (0,))

    def expired(self, now: float) -> list[Step]:
        """Return the steps that drop expired messages."""
        expired = [message for message in self._messages.values() if message.symbols.expires <= now]
        return in_groups(self._expire, expired)

    def _expire(self, message: OutboundMessage) -> None:
        if not message.over:
            self.drop(message)
            self._stats.dropped["message_expired"] += 1
