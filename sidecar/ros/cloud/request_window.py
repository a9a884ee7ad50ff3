"""Requests to one local server, no more at once than it can work on and than its queue surely holds.

A ROS server made with the default profile keeps the last 10 requests it has not taken yet; the 11th pushes the first
one out without a trace. How many lie there cannot be asked, but follows from the answers: the requests of one client
are taken in order, so an answer tells that its request and all earlier ones have left the queue. At most SAFE_SIZE
later ones are let through; the rest wait here. An earlier one that is not answered yet is in work, and takes no room in
the queue. From the silence of a server nothing is concluded: it may need a minute for each. Only what nobody waits for
any more counts no longer once it is the oldest: it is what would be pushed out first.

That is the most. As no request can be called back from a server's queue, where nothing more urgent overtakes it, only
as many are let through as the server needs to be busy (`server_capacity.py`): one or two, if it takes one after the
other. An answer may be lost, though, so after a silence one more is let through, and then another, each time after
twice as long, provided that the server has shown a sign of life meanwhile: what goes to a dead one may have run there,
and if that may happen only once, it is lost.

What is late already when its turn comes, or would be when the server has done it, must not keep the server from what is
not: after an outage a backlog comes first and what the robot asks now right behind it. So only one late request at a
time is let through, as long as others may come.
"""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING, Generic, TypeVar

from sidecar.ros.cloud.server_capacity import FIRST_LIMIT, SAFE_SIZE, ServerCapacity
from sidecar.ros.cloud.shared_queue import SharedQueue

if TYPE_CHECKING:
    from collections.abc import Callable, Hashable, Iterator

    from sidecar.core.base.values import Priority

STALL_TIMES = 3.0
"""A silence lasts so many times what the server's requests usually take ..."""
SHORT_STALL_S = 0.1
"""... but at least this long. So does the first one of a server of which nothing is known: one request may wait there,
and the other may have been lost."""
STALL_S = 1.0
"""Further silences of such a server are twice this, four times, and so on. A late request that is out for STALL_S is no
reason any more to hold the next one back."""
LATE_ONLY_S = 2.0
"""When nothing but late requests came for so long, they may fill the window: then the deadline is shorter than the
way here, and one at a time would only make it worse."""

HOPELESS_TIMES = 1.5
"""What expires within so many times what requests usually take is served last: it would be answered to nobody."""

T = TypeVar("T", bound="Hashable")


def _lives(_since: float) -> bool:
    return True


class RequestWindow(Generic[T]):
    """Which requests may go to the server now. The caller sends what `release` yields and reports `sent`."""

    __slots__ = (
        "_alive_since",
        "_capacity",
        "_freed",
        "_given_up",
        "_highest_answered",
        "_last_sent",
        "_late_number",
        "_late_released",
        "_next_late_at",
        "_only_late_since",
        "_progress_at",
        "_silences",
        "_unseen",
        "_waiting",
    )

    def __init__(self, first: int = FIRST_LIMIT, alive_since: Callable[[float], bool] = _lives) -> None:
        """`alive_since`: whether the server has shown a sign of life since then (s), other than an answer."""
        self._alive_since = alive_since
        self._capacity = ServerCapacity(first)
        self._waiting: SharedQueue[T] = SharedQueue()
        self._unseen: deque[int] = deque()
        """Numbers of the sent requests that may still lie in the server's queue, ascending."""
        self._given_up: set[int] = set()
        """Those of them that nobody waits for any more."""
        self._highest_answered = -1
        self._last_sent = -1
        self._progress_at = 0.0
        self._silences = 0
        """How often one more was let through since the last answer."""
        self._freed = False
        """Something was given up since `release` was called."""
        self._late_released = False
        """Whether what `release` yielded last was late."""
        self._late_number: int | None = None
        """The late request at the server that was sent last."""
        self._next_late_at = 0.0
        """When the next one may go although that one was not answered."""
        self._only_late_since: float | None = None

    @property
    def waiting(self) -> int:
        """How many requests wait."""
        return len(self._waiting)

    @property
    def size(self) -> int:
        """How many requests the server may have that it was not seen to have taken."""
        wanted = self._capacity.limit - self._capacity.overtaken
        return max(1, min(wanted + self._silences, SAFE_SIZE))

    def add(
        self, request: T, priority: Priority, deadline: float, expires: float, now: float, robot: Hashable = None
    ) -> None:
        """Let a robot's request wait for its turn; the caller removes it when it `expires`."""
        self._waiting.add(request, robot, priority, deadline, expires)
        if deadline > now + self._capacity.usual_s:
            self._only_late_since = None
        elif self._only_late_since is None:
            self._only_late_since = now

    def holds(self, request: T) -> bool:
        """Whether the request still waits."""
        return request in self._waiting

    def remove(self, request: T) -> None:
        """A waiting request is not wanted any more."""
        self._waiting.remove(request)

    def take_all(self) -> list[T]:
        """Return all that wait, in order of arrival, and let none wait any more."""
        return self._waiting.take_all()

    def release(self, now: float) -> Iterator[T]:
        """Yield waiting requests while the window is open; report each with `sent` before the next."""
        self._freed = False
        silent_at = self._silent_at()
        if self._waiting and silent_at is not None and silent_at <= now:
            self._progress_at = now
            self._silences += 1
        while len(self._unseen) < self.size:
            usual_s = self._capacity.usual_s
            found = self._waiting.take(now + usual_s, now + HOPELESS_TIMES * usual_s, late_too=self._late_may_go(now))
            if found is None:
                return
            request, self._late_released = found
            yield request

    def sent(self, number: int, now: float) -> None:
        """rmw gave `number` to the request just sent; numbers ascend."""
        if not self._unseen:
            self._progress_at = now
        self._last_sent = number
        self._unseen.append(number)
        self._capacity.sent(number, len(self._unseen), now)
        if self._late_released:
            self._late_number = number
            self._next_late_at = now + STALL_S

    def answered(self, number: int, now: float) -> None:
        """The server answered request `number`; an answer to what it was never sent tells nothing."""
        if number > self._last_sent:
            return
        self._progress_at = now
        self._silences = 0
        self._capacity.answered(number, now)
        self.given_up(number)
        if number > self._highest_answered:
            self._highest_answered = number
            while self._unseen and self._unseen[0] <= number:
                self._given_up.discard(self._unseen.popleft())
            self._drop_given_up()

    def given_up(self, number: int) -> None:
        """Nobody waits for the answer to request `number` any more."""
        if number == self._late_number:
            self._late_number = None
        if number > self._highest_answered:
            self._given_up.add(number)
            self._drop_given_up()
        self._capacity.given_up(number)
        self._freed = True

    def _drop_given_up(self) -> None:
        while self._unseen and self._unseen[0] in self._given_up:
            self._given_up.remove(self._unseen.popleft())

    def next_due(self) -> float | None:
        """Return when `release` may yield although no answer came, or None."""
        if not self._waiting:
            return None
        if self._freed:
            return self._progress_at
        silent_at = self._silent_at()
        if silent_at is not None or self._late_number is None or len(self._unseen) >= self.size:
            return silent_at
        if self._only_late_since is None:
            return self._next_late_at
        return min(self._next_late_at, self._only_late_since + LATE_ONLY_S)

    def _silent_at(self) -> float | None:
        """When one more may go although the window is full; None: never, or it is open, or the server may be dead."""
        if not self.size <= len(self._unseen) < SAFE_SIZE or not self._alive_since(self._progress_at):
            return None
        if self._capacity.usual_s:
            patience_s = max(SHORT_STALL_S, STALL_TIMES * self._capacity.usual_s) * 2.0**self._silences
        else:
            patience_s = STALL_S * 2.0**self._silences if self._silences else SHORT_STALL_S
        return self._progress_at + patience_s

    def _late_may_go(self, now: float) -> bool:
        if self._late_number is None or now >= self._next_late_at:
            return True
        if len(self._unseen) + self._capacity.overtaken <= self._capacity.proved > 1:
            return True  # a thread is idle or will be soon; one more than are proved, so that further threads show
        return self._only_late_since is not None and now - self._only_late_since >= LATE_ONLY_S
