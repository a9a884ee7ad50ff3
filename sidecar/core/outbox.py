"""Messages that are not delivered yet, and over which path their missing symbols travel."""

from __future__ import annotations

from typing import TYPE_CHECKING

from sidecar.core.fragments import MAX_PEER_BYTES as REASSEMBLED_PEER_BYTES
from sidecar.core.frame import symbol_count
from sidecar.core.link_events import FragmentsLost, Resend, Send, SendAbandon
from sidecar.core.outbound import OutboundMessage
from sidecar.core.redundancy import repair_symbols, worth_a_copy
from sidecar.core.shares import Shares

if TYPE_CHECKING:
    from collections.abc import Callable

    from protos.model import InterfaceName, NodeName
    from sidecar.core.events import RequestId
    from sidecar.core.link_events import PathCommand
    from sidecar.core.messages import Encoded
    from sidecar.core.path_id import PathId
    from sidecar.core.priority import Priority
    from sidecar.core.redundancy import Redundancy
    from sidecar.core.routes import Routes
    from sidecar.core.stats import EngineStats

MAX_MESSAGES = 16_384
"""All undelivered messages: one peer may have half of them, as many as requests may be in flight."""
MAX_BYTES = 256 * 1024 * 1024
"""All undelivered messages together: sixteen of the largest."""
MAX_GENERATIONS = 8
"""How often a message is sent anew under another number; a receiver that forgets it more often is not honest."""


class Outbox:
    """Undelivered messages, by number. The numbers are this session's own, never reused."""

    def __init__(self, routes: Routes, command: Callable[[PathCommand], None], stats: EngineStats) -> None:
        self._routes = routes
        self._command = command
        self._stats = stats
        self._messages: dict[int, OutboundMessage] = {}
        self._parked: dict[NodeName, dict[int, OutboundMessage]] = {}
        self._shares_of_messages = Shares(MAX_MESSAGES)
        self._shares_of_bytes = Shares(MAX_BYTES)
        self._answers: dict[tuple[NodeName, RequestId], list[OutboundMessage]] = {}
        """Undelivered answers by the robot and request they are for: one for each copy that asked."""
        self._next_number = 1

    def __len__(self) -> int:
        return len(self._messages)

    @property
    def held_bytes(self) -> int:
        """Bytes of all undelivered messages."""
        return self._shares_of_bytes.used

    def messages_to(self, peer: NodeName) -> int:
        """How many messages to this peer are undelivered."""
        return self._shares_of_messages.held(peer)

    def waiting_over(self, interface: InterfaceName) -> int:
        """How many undelivered messages use this interface."""
        return sum(interface in message.interfaces for message in self._messages.values())

    def has_room(self, peer: NodeName, size: int) -> bool:
        """Whether another message of this size may be sent to this peer."""
        held = self._shares_of_bytes
        return (
            self._shares_of_messages.fits(peer)
            and held.fits(peer, size)
            and held.held(peer) + size <= REASSEMBLED_PEER_BYTES
        )

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
        siblings: list[OutboundMessage] | None = None,
    ) -> OutboundMessage | None:
        """Send a message over `path`; None (counted) when there is no room.

        `fec`: repair symbols for each source symbol, None: by the path's loss; none at all where they find no room.
        `answers`: the request that it answers, by which `drop_answers` finds it.
        `copy_of`: the request that it is a copy of.
        `siblings`: what carries the same request already; it becomes one of them.
        """
        if not self.has_room(path.peer, content.size):
            self._stats.dropped["outbox_full"] += 1
            return None
        symbol = self._routes.symbol_to(path.peer)
        count = symbol_count(content.size, symbol)
        repairs = repair_symbols(count, fec, self._routes.loss(path))
        if repairs and not self.has_room(path.peer, (count + repairs) * symbol):
            repairs = 0
        message = OutboundMessage(
            self._take_number(),
            path,
            content,
            priority=priority,
            deadline=deadline,
            expires=expires,
            symbol=symbol,
            repairs=repairs,
            answers=answers,
            copy_of=copy_of,
            siblings=siblings,
        )
        self._enter(message)
        return message

    def _take_number(self) -> int:
        number = self._next_number
        self._next_number += 1
        return number

    def _enter(self, message: OutboundMessage) -> None:
        self._messages[message.number] = message
        if message.answers is not None:
            self._answers.setdefault((message.peer, message.answers), []).append(message)
        self._shares_of_messages.take(message.peer)
        self._shares_of_bytes.take(message.peer, message.held_bytes)
        self._command(Send(message.path, message))
        if not message.repairs and worth_a_copy(1, self._routes.loss(message.path)):
            # It leaves before the others, so a burst does not take both.
            self._send_copies(message, message.path, (message.count - 1,))

    def on_finished(self, peer: NodeName, number: int) -> OutboundMessage | None:
        """The peer holds all of it. None when it is not one of the peer's messages, or was over before."""
        message = self._messages.get(number)
        if message is None or message.peer != peer:
            return None
        self._remove(message)
        return message

    def on_answered(self, message: OutboundMessage) -> None:
        """The peer proved by its answer that it holds all of it, also when its FINISHED got lost."""
        self._remove(message.newest)

    def on_forgotten(self, peer: NodeName, number: int) -> None:
        """The peer dropped what it had of the message: the whole of it travels anew."""
        message = self._messages.get(number)
        if message is None or message.peer != peer:
            return
        self._stats.dropped["message_forgotten"] += 1
        self._remove(message)
        if message.generation < MAX_GENERATIONS:
            self._enter_anew(message, self._routes.best_to(peer) or message.path)

    def drop(self, message: OutboundMessage) -> None:
        """Nothing more of it needs to travel, as whatever it was cut into. A peer that has some of it is told so."""
        message = message.newest
        unfinished = message.begun and not message.over and message.count > 1
        self._remove(message)
        if unfinished:
            path = self._routes.best_to(message.peer)
            if path is not None:
                self._command(SendAbandon(path, message.number))

    def _remove(self, message: OutboundMessage) -> None:
        message.over = True
        if self._messages.pop(message.number, None) is not None:
            self._shares_of_messages.give_back(message.peer)
            self._shares_of_bytes.give_back(message.peer, message.held_bytes)
            self._parked.get(message.peer, {}).pop(message.number, None)
            if message.answers is not None:
                self._forget_answer((message.peer, message.answers), message)

    def drop_answers(self, peer: NodeName, request: RequestId) -> None:
        """The peer called this request off: what is unsent of its answers stays here."""
        for message in self._answers.get((peer, request), ())[:]:
            self.drop(message)

    def _forget_answer(self, key: tuple[NodeName, RequestId], message: OutboundMessage) -> None:
        answers = self._answers[key]
        answers.remove(message)
        if not answers:
            del self._answers[key]

    def drop_peer(self, peer: NodeName) -> None:
        """The peer's session is over: what was meant for it can not arrive."""
        for message in [message for message in self._messages.values() if message.peer == peer]:
            self._remove(message)
        self._parked.pop(peer, None)

    def on_lost(self, event: FragmentsLost, now: float) -> None:
        """Send lost symbols again over the best path to that peer; without one, keep them until there is one."""
        message = event.message
        if message.over:
            return
        if message.expires <= now:
            self.drop(message)
            return
        indices = message.lost(event.indices)
        if not indices:
            return
        path = self._routes.best_to(
            message.peer, avoid=event.path if event.timed_out else None, size=message.datagram_bytes
        )
        if path is None:
            self._parked.setdefault(message.peer, {})[message.number] = message
        else:
            self._resend(message, path, indices)

    def _resend(self, message: OutboundMessage, path: PathId, indices: tuple[int, ...]) -> None:
        if message.datagram_bytes > self._routes.max_datagram(path):
            self._cut_anew(message, path)
            return
        message.interfaces.add(path.interface)
        self._command(Resend(path, message, indices))
        if worth_a_copy(len(indices), self._routes.loss(path)):
            self._send_copies(message, self._routes.beside(path, message.datagram_bytes) or path, indices)

    def _send_copies(self, message: OutboundMessage, path: PathId, indices: tuple[int, ...]) -> None:
        message.interfaces.add(path.interface)
        message.copied(indices)
        self._command(Resend(path, message, indices))

    def _cut_anew(self, message: OutboundMessage, path: PathId) -> None:
        """No path carries its symbols any more: the whole of it travels again, in smaller ones."""
        self.drop(message)
        self._enter_anew(message, path)

    def _enter_anew(self, message: OutboundMessage, path: PathId) -> None:
        self._enter(message.cut_anew(self._take_number(), path, self._routes.symbol_to(path.peer)))

    def on_path_up(self, path: PathId) -> None:
        """Send what waited for a path to this peer."""
        for message in self._parked.pop(path.peer, {}).values():
            missing = message.lost(message.give_up())
            if missing:
                self._resend(message, path, missing)

    def on_interface_gone(self, interface: InterfaceName, now: float) -> None:
        """The interface's link is gone with all it had queued: its messages take other paths.

        What of them is on its way over another interface travels twice; nobody knows any more which it is.
        """
        for message in [message for message in self._messages.values() if interface in message.interfaces]:
            message.interfaces.discard(interface)
            self.on_lost(FragmentsLost(message.path, message, message.give_up()), now)

    def expire(self, now: float) -> None:
        """Drop messages whose time is over."""
        for message in [message for message in self._messages.values() if message.expires <= now]:
            self.drop(message)
            self._stats.dropped["message_expired"] += 1
