"""Robot side: takes back copies that nobody waits for any more, and tells their servers."""

from __future__ import annotations

from collections import OrderedDict
from typing import TYPE_CHECKING

from plr.sidecar.core.base.values import Priority
from plr.sidecar.core.robot.request.request import CopyState
from plr.sidecar.core.wire.messages import CancelMessage, encode_message

if TYPE_CHECKING:
    from plr.protos.model.ids import NodeName
    from plr.sidecar.core.base.values import RequestId
    from plr.sidecar.core.robot.request.request import Copy, Request
    from plr.sidecar.core.seam.stats import EngineStats
    from plr.sidecar.core.transfer.outbox import Outbox
    from plr.sidecar.core.transfer.routes import Routes

MAX_CALLED_OFF = 1024
"""Most ids of requests with called-off copies, kept to tell answers that were on their way from strays."""
SMALL_ANSWER_BYTES = 1024
"""Largest answer that fits one datagram with its header. Its server has sent it to its other copies as well: a cancel
would cost more than it could save there."""
CANCEL_DEADLINE_S = 0.1
"""Deadline of a cancel. It is worth most at once, as a server that has not begun need not. Of the urgent messages only
those with a shorter deadline go first."""


class CallingOff:
    """Calls copies off, and remembers their requests."""

    def __init__(self, routes: Routes, outbox: Outbox, stats: EngineStats) -> None:
        self._routes = routes
        self._outbox = outbox
        self._stats = stats
        self._requests: OrderedDict[RequestId, None] = OrderedDict()

    def __contains__(self, request_id: RequestId) -> bool:
        """Return whether copies of this request were called off recently."""
        return request_id in self._requests

    def __len__(self) -> int:
        """Return the number of requests remembered."""
        return len(self._requests)

    def call_off(self, request: Request, copies: list[Copy], now: float, *, untold: NodeName | None = None) -> None:
        """Send no more of these copies. Tell their servers, except `untold`, servers that nothing of them may have left
        for, and servers at which another copy is still awaited."""
        for copy in copies:
            copy.state = CopyState.DEAD
            copy.ended_at = now
            self._outbox.drop(copy.message)
            self._stats.called_off[copy.path.interface, copy.path.peer, request.service] += 1
        servers = {copy.path.peer for copy in copies if copy.message.may_have_left}
        servers -= {untold, *(copy.path.peer for copy in request.pending())}
        for server in servers:
            path = self._routes.best_to(server)
            cancel = encode_message(CancelMessage(request.id))
            if path is not None and self._outbox.admits(server, cancel.size):
                self._outbox.send(
                    path,
                    cancel,
                    priority=Priority.HIGH,
                    deadline=now + CANCEL_DEADLINE_S,
                    expires=request.expires_at,
                )
        if copies:
            self._requests[request.id] = None
            if len(self._requests) > MAX_CALLED_OFF:
                self._requests.popitem(last=False)
