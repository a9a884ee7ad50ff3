"""Cloud side: holds answers until they are delivered or nobody waits for them any more.

An answer that finds no room to be sent waits for it. Each robot has lines of its own, one for each lane (`room.py`), so
none holds up another. Several copies that asked share the answer's bytes here, but each is sent separately: the answer
goes over one path first, and to the other copies when no answer waits for its first sending.

The outcome of a request must not vanish: an answer that has no room to wait either, or that has not begun to leave when
its time is nearly over, is replaced by a rejection that says so.
"""

from __future__ import annotations

import heapq
from collections import OrderedDict
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import chain, count, islice
from typing import TYPE_CHECKING

from plr.sidecar.core.base.fair_share import Shares
from plr.sidecar.core.base.request_id import is_race
from plr.sidecar.core.base.slices import in_groups
from plr.sidecar.core.base.timers import first_of
from plr.sidecar.core.base.values import PathState, Priority, RejectReason
from plr.sidecar.core.transfer.room import Lane
from plr.sidecar.core.transfer.waiting_line import WaitingLine
from plr.sidecar.core.wire.messages import RejectionMessage, ResponseMessage, encode_message

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Iterator

    from plr.protos.model.ids import NodeName
    from plr.sidecar.core.base.slices import Backlog, Step
    from plr.sidecar.core.base.values import PathId, RequestId
    from plr.sidecar.core.cloud.executions import Reply, ReplyTo
    from plr.sidecar.core.message.symbols import MessageSymbols
    from plr.sidecar.core.rules.service_rule import Rules
    from plr.sidecar.core.seam.stats import EngineStats
    from plr.sidecar.core.transfer.outbox import Outbox
    from plr.sidecar.core.transfer.routes import Routes
    from plr.sidecar.core.wire.messages import Encoded

MAX_ANSWERS = 32_768
"""Most answers and rejections waiting or under way; one robot may have half: twice what it may have in flight."""
MAX_ANSWER_BYTES = 512 * 1024 * 1024
"""Most payload bytes of those answers, as many as of the requests that run; one robot may hold half."""
TELL_BEFORE = 0.1
"""An answer of which nothing has left when this share of its time remains ..."""
TELL_BEFORE_S = 1.0
"""... but no more than this (s), is given up: the robot has time to learn it, and perhaps to ask elsewhere."""
ROBOTS_AT_ONCE = 16
"""Further robots whose lines are looked at when a message ends: the limit on messages is shared by all robots."""
TIMER_SLACK = 1024
"""Timers of finished answers allowed to remain before they are swept out."""


@dataclass(slots=True, eq=False)
class _Answer:
    """A response, or a rejection of one copy."""

    number: int
    reply: Reply
    """The reply to the first copy that asked."""
    content: Encoded
    """That reply as a message. Those to other copies are equally long."""
    size: int
    """Bytes of one of these messages."""
    waiting: dict[int, ReplyTo] = field(default_factory=dict)
    """Copies it was not sent to yet."""
    sent: dict[int, ReplyTo] = field(default_factory=dict)
    """Copies it was sent to."""
    messages: list[MessageSymbols] = field(default_factory=list)
    """Messages that carry a large answer: siblings, so that overloaded paths share it."""

    @property
    def robot(self) -> NodeName:
        return self.reply.to.path.peer

    @property
    def request_id(self) -> RequestId:
        return self.reply.message.request_id

    @property
    def held(self) -> int:
        """Return the bytes that stay in memory for it."""
        message = self.reply.message
        return len(message.payload) if isinstance(message, ResponseMessage) else 0

    @property
    def lane(self) -> Lane:
        return Lane.of(self.size)


class _Lines:
    """Lines of answers that wait to be sent to one robot in one lane."""

    __slots__ = ("copies", "firsts")

    def __init__(self) -> None:
        self.firsts: WaitingLine[int] = WaitingLine()
        """Answers that were sent to no copy yet."""
        self.copies: WaitingLine[tuple[int, int]] = WaitingLine()
        """(answer, copy) of answers that were sent to another copy."""

    def __len__(self) -> int:
        return len(self.firsts) + len(self.copies)


class Answers:
    """All answers on their way."""

    def __init__(self, rules: Rules, routes: Routes, outbox: Outbox, stats: EngineStats, backlog: Backlog) -> None:
        self._rules = rules
        self._routes = routes
        self._outbox = outbox
        self._stats = stats
        self._backlog = backlog
        self._answers: dict[int, _Answer] = {}
        self._of: dict[NodeName, dict[RequestId, list[_Answer]]] = {}
        self._got: dict[NodeName, dict[int, None]] = {}
        """Answers that the robot has received and that wait only to be sent to further copies."""
        self._lines: OrderedDict[NodeName, tuple[_Lines, ...]] = OrderedDict()
        """Lines of the robots with waiting answers, the one whose turn is longest ago first."""
        self._going: dict[NodeName, None] = {}
        """Robots whose lines may have something to send."""
        self._number_shares = Shares(MAX_ANSWERS)
        self._byte_shares = Shares(MAX_ANSWER_BYTES)
        self._timers: list[tuple[float, int]] = []
        self._numbers = count()

    def __len__(self) -> int:
        """Return the number of answers that wait or are under way."""
        return len(self._answers)

    @property
    def held_bytes(self) -> int:
        """Return the bytes of the answers' payloads."""
        return self._byte_shares.used

    def unsent(self, robots: Collection[NodeName]) -> int:
        """Return the number of answers to these robots that wait for room and are not on their way to any copy."""
        return sum(len(line.firsts) for robot in robots for line in self._lines.get(robot, ()))

    # -- inputs ---------------------------------------------------------------------------------------------------

    def send(self, replies: list[Reply], now: float) -> None:
        """Send these replies as soon as there is room."""
        if len(replies) == 1 and self._send_alone(replies[0], now):
            return
        for reply in replies:
            self._take(reply, now)
        for reply in replies:
            # As many as came: these, or others that have waited longer. A robot without room has none for a second one.
            self._send_next(reply.to.path.peer, now)
        self._let_go((reply.to.path.peer for reply in replies), now)

    def _send_alone(self, reply: Reply, now: float) -> bool:
        """Send a reply at once if nothing waits for its robot; return False if it has to wait or is known."""
        robot = reply.to.path.peer
        if robot in self._lines or self._known(robot, reply) is not None:
            return False
        answer = self._enter(reply, now)
        if answer is None:
            return True  # counted
        answer.waiting[reply.to.copy] = reply.to
        if self._outbox.has_room(robot, answer.size):
            self._send(answer, reply.to.copy)
        else:
            self._line_up(answer)
        return True

    def _take(self, reply: Reply, now: float) -> None:
        copy = reply.to.copy
        answer = self._known(reply.to.path.peer, reply)
        if answer is None:
            answer = self._enter(reply, now)
            if answer is not None:
                answer.waiting[copy] = reply.to
                self._line_up(answer)
        elif copy not in answer.waiting and copy not in answer.sent:
            answer.waiting[copy] = reply.to
            if answer.sent:
                self._line_up_copies(answer, (copy,))
        # Otherwise that copy came twice, as another message: its answer is on its way.

    def _known(self, robot: NodeName, reply: Reply) -> _Answer | None:
        """Return the answer under way that says the same or more: its bytes may be kept only here.

        A copy that was rejected is rejected once, whatever its sender writes into it when it sends it again.
        """
        message = reply.message
        for answer in self._of.get(robot, {}).get(message.request_id, ()):
            known = answer.reply.message
            if isinstance(known, ResponseMessage):
                if isinstance(message, ResponseMessage) or message.reason is RejectReason.FORGOTTEN:
                    return answer
            elif isinstance(message, RejectionMessage) and known.copy == message.copy:
                return answer
        return None

    def _enter(self, reply: Reply, now: float) -> _Answer | None:
        content = encode_message(reply.message)
        answer = _Answer(next(self._numbers), reply, content, content.size)
        robot, held = answer.robot, answer.held
        if not self._number_shares.fits(robot):
            self._stats.dropped["answers_full"] += 1
            return None
        if held and not (self._byte_shares.fits(robot, held) or self._let_copies_go(robot, held)):
            self._stats.dropped["answers_full"] += 1
            return self._enter(self._refusal(answer, "too much data already waits to be sent to this robot"), now)
        self._number_shares.take(robot)
        self._byte_shares.take(robot, held)
        self._answers[answer.number] = answer
        self._of.setdefault(robot, {}).setdefault(answer.request_id, []).append(answer)
        left_s = reply.expires - now
        self._arm(reply.expires - (min(TELL_BEFORE_S, TELL_BEFORE * left_s) if held else 0.0), answer.number)
        return answer

    def _refusal(self, answer: _Answer, why: str) -> Reply:
        text = f"the request ran, but its answer of {answer.held} bytes is not sent: {why}"
        rejection = RejectionMessage(answer.request_id, answer.reply.to.copy, RejectReason.FORGOTTEN, text)
        # The answer's deadline may be over; the rejection is useful until `expires`, and waits behind no large answer.
        return replace(answer.reply, message=rejection, priority=Priority.HIGH, deadline=answer.reply.expires)

    def _let_copies_go(self, robot: NodeName, held: int) -> bool:
        """Make room in memory by dropping answers that the robot has received already."""
        for number in list(self._got.get(robot, ())):
            self._forgo_copies(self._answers[number])
            if self._byte_shares.fits(robot, held):
                return True
        return False

    def _forgo_copies(self, answer: _Answer) -> None:
        self._stats.dropped["answer_copies_unsent"] += len(answer.waiting)
        self._remove(answer)

    # -- outputs --------------------------------------------------------------------------------------------------

    def on_room(self, now: float) -> None:
        """Send what waits for room, as messages have ended."""
        robots: dict[NodeName, None] = {}
        for robot, request_id in self._outbox.take_answers_over():
            robots[robot] = None
            for answer in self._of.get(robot, {}).get(request_id, [])[:]:
                if answer.sent and answer.waiting:
                    self._got.setdefault(robot, {})[answer.number] = None
                elif answer.sent:
                    self._remove(answer)
        for robot in list(islice(self._lines, ROBOTS_AT_ONCE)):
            robots[robot] = None
            self._lines.move_to_end(robot)
        self._let_go(robots, now)

    def _let_go(self, robots: Iterable[NodeName], now: float) -> None:
        """Send what waits for these robots and has room now, as much at once as this turn allows."""
        self._going.update((robot, None) for robot in robots if self._next(robot, now) is not None)
        if self._going:
            self._backlog.add(self._steps, now, "answers")

    def _steps(self) -> Iterator[Step]:
        """Send one answer at a time, for each robot in turn."""
        while self._going:
            robot = next(iter(self._going))
            del self._going[robot]
            yield partial(self._go, robot)

    def _go(self, robot: NodeName, now: float) -> None:
        if self._send_next(robot, now):
            self._going[robot] = None

    def _next(self, robot: NodeName, now: float) -> tuple[_Answer, int | None] | None:
        """Return the next answer that has room, and the copy to send it to; None as copy: not sent yet."""
        for line in self._lines.get(robot, ()):
            if (number := line.firsts.first(now)) is not None:
                answer, copy = self._answers[number], None
            elif (key := line.copies.first(now)) is not None:
                answer, copy = self._answers[key[0]], key[1]
            else:
                continue
            if self._outbox.has_room(robot, answer.size):
                return answer, copy
        return None

    def _send_next(self, robot: NodeName, now: float) -> bool:
        """Send one waiting message; return whether there was one, and room for it."""
        found = self._next(robot, now)
        if found is None:
            return False
        answer, copy = found
        line = self._lines_of(answer)
        if copy is None:
            line.firsts.went(answer.number)
            self._send(answer, self._best_copy(answer))
            self._line_up_copies(answer, answer.waiting)
        else:
            line.copies.went((answer.number, copy))
            self._send(answer, copy)
        self._forget_lines(robot)
        return True

    def _best_copy(self, answer: _Answer) -> int:
        """Return the copy to send a large answer to first: its path is up and has the least to carry."""

        def load(copy: int) -> tuple[bool, int]:
            path = answer.waiting[copy].path
            return self._routes.state(path) is not PathState.UP, self._outbox.sent_over(path)

        return min(answer.waiting, key=load) if answer.lane is Lane.LARGE else next(iter(answer.waiting))

    def _send(self, answer: _Answer, copy: int) -> None:
        reply = answer.reply
        to = answer.sent[copy] = answer.waiting.pop(copy)
        self._forget_got(answer)
        path, *others = self._carriers(to, answer.request_id) if to.beside else (to.path,)
        if self._routes.state(path) is PathState.DOWN:
            path = self._routes.best_to(path.peer) or path
        rule = self._rules.find(reply.service)
        message = reply.message
        self._outbox.send(
            path,
            answer.content if copy == message.copy else encode_message(replace(message, copy=copy)),
            priority=reply.priority,
            deadline=reply.deadline,
            expires=reply.expires,
            fec=rule.fec if rule else None,
            answers=answer.request_id,
            siblings=answer.messages if answer.lane is Lane.LARGE and not is_race(answer.request_id) else None,
            shared_by=others,
            repeats=1.0,
        )

    def _carriers(self, to: ReplyTo, request_id: RequestId) -> list[PathId]:
        """Return the paths that carry an answer together: those by which its request came, as far as they are up.

        A race measures each path alone.
        """
        state, beside = self._routes.state, () if is_race(request_id) else to.beside
        carriers = [path for path in (to.path, *beside) if state(path) is PathState.UP]
        return carriers or [to.path]

    def _line_up(self, answer: _Answer) -> None:
        line = self._lines_of(answer).firsts
        line.add(answer.number, answer.reply.priority, answer.reply.deadline, answer.size)

    def _line_up_copies(self, answer: _Answer, copies: Iterable[int]) -> None:
        reply = answer.reply
        for copy in copies:
            line = self._lines_of(answer).copies
            line.add((answer.number, copy), reply.priority, reply.deadline, answer.size)

    def _lines_of(self, answer: _Answer) -> _Lines:
        lines = self._lines.get(answer.robot)
        if lines is None:
            lines = self._lines[answer.robot] = tuple(_Lines() for _ in Lane)
        return lines[answer.lane]

    def _forget_lines(self, robot: NodeName) -> None:
        if not any(map(len, self._lines.get(robot, ()))):
            self._lines.pop(robot, None)

    # -- other ends -----------------------------------------------------------------------------------------------

    def drop(self, robot: NodeName, request_id: RequestId) -> None:
        """Drop what is unsent of the answers to a request that the robot called off."""
        for answer in self._of.get(robot, {}).get(request_id, [])[:]:
            self._remove(answer)
        self._outbox.drop_answers(robot, request_id)

    def drop_robot(self, robot: NodeName) -> list[Step]:
        """End what was on its way to a robot whose session is over; return the steps that drop it."""
        self._lines.pop(robot, None)  # at once: dropping makes room, which none of these answers may take
        return in_groups(self._remove, chain.from_iterable(self._of.get(robot, {}).values()))

    def _remove(self, answer: _Answer) -> None:
        if self._answers.pop(answer.number, None) is None:
            return
        robot, request_id = answer.robot, answer.request_id
        self._number_shares.give_back(robot)
        self._byte_shares.give_back(robot, answer.held)
        self._forget_got(answer)
        answer.messages.clear()
        of_robot = self._of[robot]
        of_robot[request_id].remove(answer)
        if not of_robot[request_id]:
            del of_robot[request_id]
            if not of_robot:
                del self._of[robot]
        if answer.waiting:
            line = self._lines_of(answer)
            line.firsts.remove(answer.number)
            for copy in answer.waiting:
                line.copies.remove((answer.number, copy))
            self._forget_lines(robot)

    def _forget_got(self, answer: _Answer) -> None:
        got = self._got.get(answer.robot)
        if got is not None:
            got.pop(answer.number, None)
            if not got:
                del self._got[answer.robot]

    # -- time -----------------------------------------------------------------------------------------------------

    def _arm(self, at: float, number: int) -> None:
        heapq.heappush(self._timers, (at, number))
        if len(self._timers) > 2 * len(self._answers) + TIMER_SLACK:
            self._timers = [timer for timer in self._timers if timer[1] in self._answers]
            heapq.heapify(self._timers)

    def next_timer(self) -> float | None:
        """Return when to call `handle_timer`."""
        return first_of(self._timers, self._answers)

    def handle_timer(self, now: float) -> None:
        """Give up answers that are useless by now, and reject those of which nothing has left."""
        while self._timers and self._timers[0][0] <= now and self._backlog.allows(now):
            answer = self._answers.get(heapq.heappop(self._timers)[1])
            if answer is not None:
                self._judge(answer, now)

    def _judge(self, answer: _Answer, now: float) -> None:
        robot, request_id = answer.robot, answer.request_id
        if answer.sent and not self._outbox.carries_answer(robot, request_id):
            self._forgo_copies(answer)
        elif answer.reply.expires <= now:
            if not answer.sent:
                self._stats.dropped["answer_unsent"] += 1
            self._remove(answer)
        elif self._outbox.answer_has_begun(robot, request_id):
            self._arm(answer.reply.expires, answer.number)
        else:
            self._stats.dropped["answer_unsent"] += 1
            self.drop(robot, request_id)
            self.send(self._refusals(answer), now)

    def _refusals(self, answer: _Answer) -> list[Reply]:
        refusal = self._refusal(answer, "no part of it could be sent before its time was nearly over")
        return [
            replace(refusal, to=to, message=replace(refusal.message, copy=copy))
            for copy, to in {**answer.sent, **answer.waiting}.items()
        ]
