"""Limits the requests at one local server to what it can work on at once and what its queue surely holds.

A ROS server with the default profile keeps the last 10 requests it has not taken yet; the 11th silently pushes out the
first. There is no way to ask how many lie there, but the answers tell: a server takes the requests of one client in
order, so an answer shows that its request and all earlier ones have left the queue. At most SAFE_SIZE later ones are
let through; the rest wait here. An earlier one that is not answered yet is in work, and takes no room in the queue. A
server's silence proves nothing: it may need a minute for each request. Only a request that is no longer awaited stops
counting once it is the oldest, as it would be pushed out first.

That is the upper limit. No request can be called back from a server's queue, where nothing more urgent overtakes it. So
only as many are let through as keep the server busy (`server_capacity.py`): one or two, if it takes one after the
other. But an answer may be lost. So after a silence one more is let through, and then another, each time after twice as
long, provided that the server has shown a sign of life meanwhile. A request sent to a dead server may have run there;
if it may run only once, it is lost.

A request that is late when its turn comes, or would be when it is answered, must not keep the server from those that
are not: after an outage a backlog comes first, and the robot's new requests right behind it. So only one late request
at a time is let through, as long as others may come.
"""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING, Generic, TypeVar

from plr.sidecar.ros.cloud.server_capacity import FIRST_LIMIT, SAFE_SIZE, ServerCapacity
from plr.sidecar.ros.cloud.shared_queue import SharedQueue

if TYPE_CHECKING:
    from collections.abc import Callable, Hashable, Iterator

    from plr.sidecar.core.base.values import Priority

STALL_TIMES = 3.0
"""A silence lasts this many times the usual time of the server's requests ..."""
SHORT_STALL_S = 0.1
"""... but at least this long. The first silence of a server of unknown speed lasts this long too: one request may wait
there, and the other may have been lost."""
STALL_S = 1.0
"""Further silences of such a server last twice this, four times this, and so on. A late request that has been out for
STALL_S no longer holds back the next one."""
LATE_ONLY_S = 2.0
"""When only late requests have come for this long, they may fill the window: then the deadline is shorter than the way
here, and sending one at a time would only make it worse."""

HOPELESS_TIMES = 1.5
"""A request that expires within this many times the usual time is served last: its answer would come too late."""

T = TypeVar("T", bound="Hashable")


def _lives(_since: float) -> bool:
    return True


class RequestWindow(Generic[T]):
    """Decides which requests may go to the server now. The caller sends what `release` yields and reports `sent`."""

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
        """Take `alive_since`: whether the server has shown a sign of life, other than an answer, since then (s)."""
        self._alive_since = alive_since
        self._capacity = ServerCapacity(first)
        self._waiting: SharedQueue[T] = SharedQueue()
        self._unseen: deque[int] = deque()
        """Numbers of the sent requests that may still lie in the server's queue, ascending."""
        self._given_up: set[int] = set()
        """Those of them that are no longer awaited."""
        self._highest_answered = -1
        self._last_sent = -1
        self._progress_at = 0.0
        self._silences = 0
        """How often one more request was let through since the last answer."""
        self._freed = False
        """Whether something was given up since the last `release`."""
        self._late_released = False
        """Whether the request that `release` yielded last was late."""
        self._late_number: int | None = None
        """The last late request sent that is still at the server."""
        self._next_late_at = 0.0
        """When the next late one may go although that one is not answered."""
        self._only_late_since: float | None = None

    @property
    def waiting(self) -> int:
        """Number of waiting requests."""
        return len(self._waiting)

    @property
    def size(self) -> int:
        """Number of requests that the server may have without being seen to have taken them."""
        wanted = self._capacity.limit - self._capacity.overtaken
        return max(1, min(wanted + self._silences, SAFE_SIZE))

    def add(
        self, request: T, priority: Priority, deadline: float, expires: float, now: float, robot: Hashable = None
    ) -> None:
        """Queue a robot's request for its turn; the caller removes it when it `expires`."""
        self._waiting.add(request, robot, priority, deadline, expires)
        if deadline > now + self._capacity.usual_s:
            self._only_late_since = None
        elif self._only_late_since is None:
            self._only_late_since = now

    def holds(self, request: T) -> bool:
        """Return whether the request still waits."""
        return request in self._waiting

    def remove(self, request: T) -> None:
        """Remove a waiting request that is no longer wanted."""
        self._waiting.remove(request)

    def take_all(self) -> list[T]:
        """Remove and return all waiting requests, in order of arrival."""
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
        """Note that rmw gave `number` to the request just sent; numbers ascend."""
        if not self._unseen:
            self._progress_at = now
        self._last_sent = number
        self._unseen.append(number)
        self._capacity.sent(number, len(self._unseen), now)
        if self._late_released:
            self._late_number = number
            self._next_late_at = now + STALL_S

    def answered(self, number: int, now: float) -> None:
        """Note that the server answered request `number`; ignore an answer to a request that was never sent."""
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
        """Note that the answer to request `number` is no longer awaited."""
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
        """Return when one more may go although the window is full; None: never, or open, or the server may be dead."""
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
            return True  # a thread is idle or soon will be; one more than proved, so that further threads show
        return self._only_late_since is not None and now - self._only_late_since >= LATE_ONLY_S
