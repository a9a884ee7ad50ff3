"""Drives one link: a thread owns one interface's socket, its Link and its StunClient.

It only moves bytes, commands and events and arms one timer; the cores make every decision.
"""

from __future__ import annotations

import logging
import threading
import time
from collections import deque
from typing import TYPE_CHECKING, Protocol

from plr.sidecar.core.base.values import PathState
from plr.sidecar.core.link.sender import Batch
from plr.sidecar.core.path.history import PathHistory
from plr.sidecar.core.seam.links import PathChanged, Rebind
from plr.sidecar.core.wire.frame import FIRST_BYTE, MAX_DATAGRAM_BYTES
from plr.sidecar.net.batch_socket import RECEIVE_CALLS, BatchSocket
from plr.sidecar.net.path_log import PathLog
from plr.sidecar.net.sources import Sources
from plr.sidecar.net.thread_state import is_in_a_call
from plr.sidecar.net.waiter import Waiter

if TYPE_CHECKING:
    import socket
    from collections.abc import Callable

    from plr.protos.model.ids import Address, InterfaceName
    from plr.sidecar.core.link.link import Link
    from plr.sidecar.core.link.pinging import Pong
    from plr.sidecar.core.seam.links import LinkCommand, LinkEvent
    from plr.sidecar.core.stun.client import StunClient
    from plr.sidecar.core.stun.events import StunEvent

log = logging.getLogger(__name__)

OURS = FIRST_BYTE & 0xF0
"""First bytes from here on are ours, of any version; lower ones are STUN's."""
BURSTS_PER_TURN = 4
"""Bursts of the link sent before timers and arrivals are looked at again: some milliseconds at most."""
SLOW_SEND_S = 0.02
"""A driver that takes this long for a burst goes on only after the timers: paths may have gone down."""
BLOCKED_TIMER_S = 0.005
"""Interval of looking at timers while the socket takes nothing: what is due may wait for the socket itself."""
ERROR_PAUSE_S = 0.1
"""Pause after an internal error, which may recur at every turn."""
MAX_INBOX = 65_536
"""Most commands that wait for the thread; the engine's outbox is capped far below."""


class LinkOwner(Protocol):
    """The receiver of the thread's reports."""

    def on_link_events(self, events: list[LinkEvent]) -> None:
        """Take the link's events; called on the link's thread."""

    def on_pong(self, pong: Pong) -> None:
        """Take the result of a ping; called on the link's thread, which must not wait there."""


class InterfaceThread:
    """One interface's thread."""

    def __init__(
        self,
        sock: socket.socket,
        link: Link,
        stun: StunClient | None,
        owner: LinkOwner,
        on_stun: Callable[[StunEvent], None] = lambda _: None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Report to `owner`, and STUN events to `on_stun`; both are called on the thread."""
        self.link = link
        self.port: int = sock.getsockname()[1]
        self._socket = sock
        self._stun = stun
        self._owner = owner
        self._on_stun = on_stun
        self._clock = clock
        self._inbox: deque[LinkCommand | Callable[[StunClient], None]] = deque()
        self._waiter = Waiter(sock.fileno(), clock)
        self._batches = BatchSocket(sock, link.stats, self._on_too_big)
        self._sources = Sources(sock)
        self._unsent: deque[Batch] = deque()
        """At most one burst: the link is asked for the next one only when it has left."""
        self._more = False
        self._path_log = PathLog()
        self.history = PathHistory(link.stats.dropped)
        self._stopping = False
        self._abandoned = False
        self._turn_began: float | None = None
        self._thread = threading.Thread(target=self._run, name=f"plr-{link.identity.interface}", daemon=True)

    @property
    def stun(self) -> StunClient | None:
        """Return its STUN client, for reading only; None if STUN is off."""
        return self._stun

    @property
    def interface(self) -> InterfaceName:
        """Return the interface this thread owns."""
        return self.link.identity.interface

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def stop(self, timeout_s: float) -> bool:
        """End the thread after what is queued has left, and close the socket; False when it did not end in time."""
        self._stopping = True
        self.wake()
        self._thread.join(timeout_s)
        if self._thread.is_alive():
            self._abandoned = True
            log.warning("%s: the thread did not end within %.1f s", self.interface, timeout_s)
        return not self._abandoned

    def post(self, command: LinkCommand | Callable[[StunClient], None]) -> None:
        """Queue a command for the link (or a call on the STUN client); follow it with `wake`."""
        if len(self._inbox) >= MAX_INBOX:
            self.link.stats.dropped["inbox_full"] += 1
            return
        self._inbox.append(command)

    def wake(self) -> None:
        """Make the thread look at its inbox; nearly free while it is awake."""
        self._waiter.wake()

    def in_turn_for(self, now: float) -> float:
        """Return how long (s) the thread's turn has lasted; 0 while it waits."""
        began = self._turn_began
        return 0.0 if began is None else now - began

    def is_in_a_call(self) -> bool:
        """Return whether it waits for the kernel: not for a processor, the interpreter or a lock."""
        return is_in_a_call(self._thread.native_id)

    # Runs on the thread ------------------------------------------------------------------------------------------

    def _run(self) -> None:
        waiter = self._waiter
        try:
            while not self._stopping:
                readable = waiter.wait(self._due(), for_room=bool(self._unsent))
                self._guarded_turn(readable=readable)
            if not self._abandoned:
                self._guarded_turn(readable=False)
        finally:
            waiter.close()
            self._socket.close()

    def _guarded_turn(self, *, readable: bool) -> None:
        self._turn_began = self._clock()
        try:
            self._turn(readable=readable)
        except Exception:
            # A bug must neither silence the interface permanently nor stay hidden.
            log.exception("%s: internal error; the interface continues", self.interface)
            self.link.stats.dropped["internal_error"] += 1
            time.sleep(ERROR_PAUSE_S)
        finally:
            self._turn_began = None

    def _due(self) -> float:
        """Return when the next turn is due if nobody wakes the thread."""
        due = self.link.next_timer()
        if self._stun is not None:
            stun_due = self._stun.next_timer()
            if stun_due is not None:
                due = min(due, stun_due)
        if self._unsent:
            return max(due, self._clock() + BLOCKED_TIMER_S)
        return 0.0 if self._more else due

    def _turn(self, *, readable: bool) -> None:
        # Work that somebody waits for comes first, other work after it: at a low rate every step runs in cold caches,
        # for the first time in a long while, and costs several times what it does under load.
        if readable:
            self._receive(at_most=1)
        self._exchange()
        self._send()
        if readable:
            self._receive()
        self.link.handle_timer(self._clock())
        self._exchange()
        self._stun_turn()
        self._send()

    def _receive(self, *, at_most: int = RECEIVE_CALLS) -> None:
        link = self.link
        for data, segment, source in self._batches.receive(at_most):
            if data[0] >= OURS and segment <= MAX_DATAGRAM_BYTES:
                link.receive_batch(data, segment, source, self._clock())
            else:
                self._receive_stun(data, segment, source)

    def _receive_stun(self, data: memoryview, segment: int, source: Address) -> None:
        stats = self.link.stats
        for start in range(0, len(data), segment):
            datagram = bytes(data[start : start + segment])
            if self._stun is not None and self._stun.receive_datagram(datagram, source, self._clock()):
                stats.datagrams["received", "stun"] += 1
            else:
                stats.dropped["malformed"] += 1

    def _execute(self) -> None:
        inbox = self._inbox
        self._waiter.looked()
        while inbox:
            command = inbox.popleft()
            if callable(command):
                if self._stun is not None:
                    command(self._stun)
            else:
                self.link.execute(command, self._clock())
                if isinstance(command, Rebind):
                    for path in self.link.living():
                        self.link.note_source(path, self._sources.towards)

    def _exchange(self) -> None:
        """Hand events to the engine until neither side has more for the other."""
        link = self.link
        self._execute()
        while True:
            events = []
            while (event := link.next_event()) is not None:
                events.append(event)
            if events:
                self._owner.on_link_events(events)
                self._note_paths(events)
            while link.pongs:
                self._owner.on_pong(link.pongs.popleft())
            if not self._inbox and not events:
                return
            self._execute()

    def _note_paths(self, events: list[LinkEvent]) -> None:
        down = False
        for event in events:
            if isinstance(event, PathChanged):
                self._path_log.note(event)
                self.history.note(event, self._clock())
                down = down or event.state is PathState.DOWN
                if event.state is PathState.UP:
                    self.link.note_source(event.path, self._sources.towards)
        if down:
            self._drop_unsent()

    def _stun_turn(self) -> None:
        stun = self._stun
        if stun is None:
            return
        stun.handle_timer(self._clock())
        for data, address in stun.datagrams_to_send():
            self._batches.send(Batch(address, data, len(data)))  # what finds no room is retransmitted in time
            self.link.stats.datagrams["sent", "stun"] += 1
        while (event := stun.next_event()) is not None:
            self._on_stun(event)

    def _send(self) -> None:
        self._more = True
        sent = self._flush()
        for _ in range(BURSTS_PER_TURN):
            if not sent:
                return
            batches = self.link.batches_to_send(self._clock())
            if not batches:
                self._more = False
                return
            self._unsent.extend(batches)
            sent = self._flush()
            self._exchange()

    def _flush(self) -> bool:
        """Send what waits; return False when some of it has to go on waiting."""
        unsent = self._unsent
        began = self._clock()
        while unsent:
            if self._abandoned:
                return False
            rest = self._batches.send(unsent.popleft())
            if rest is not None:
                unsent.appendleft(rest)
                return False
            if unsent and self._clock() - began > SLOW_SEND_S:
                return False
        return True

    def _drop_unsent(self) -> None:
        """Drop what waits for paths that went down: they handed it back, and nothing stale must leave."""
        unsent, self._unsent = self._unsent, deque()
        for batch in unsent:
            if self.link.in_use(batch.address):
                self._unsent.append(batch)
            else:
                self.link.stats.dropped["unsent_of_path_down"] += batch.datagrams

    def _on_too_big(self, destination: Address, size: int) -> None:
        self.link.on_too_big(destination, size, self._clock())
