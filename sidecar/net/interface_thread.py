"""The driver of one link: a thread that owns one interface's socket, its Link and its StunClient.

It only moves bytes, commands and events and arms one timer; every decision is in the cores.
"""

from __future__ import annotations

import errno
import logging
import threading
import time
from collections import deque
from typing import TYPE_CHECKING, Protocol

from sidecar.core.frame import FIRST_BYTE, MAX_DATAGRAM_BYTES
from sidecar.core.link_events import PathChanged
from sidecar.net.path_log import PathLog
from sidecar.net.sockets import normalise, to_sockaddr
from sidecar.net.waiter import Waiter

if TYPE_CHECKING:
    import socket
    from collections.abc import Callable

    from protos.model import Address, InterfaceName
    from sidecar.core.link import Link
    from sidecar.core.link_events import LinkCommand, LinkEvent
    from sidecar.core.stun_client import StunClient
    from sidecar.core.stun_events import StunEvent

log = logging.getLogger(__name__)

RECEIVE_BATCH = 64
"""Datagrams read before anything else is looked at."""
RECEIVE_BYTES = MAX_DATAGRAM_BYTES + 1
"""Longer than any datagram of ours: a longer one is truncated, hence malformed, hence dropped."""
BLOCKED_TIMER_S = 0.005
"""While the socket takes nothing, timers are looked at this often: what is due may wait for the socket itself."""
ERROR_PAUSE_S = 0.1
"""After an internal error, which may repeat itself at every turn."""
MAX_INBOX = 65_536
"""Commands that wait for the thread; the engine's outbox is capped far below it."""


class LinkOwner(Protocol):
    """What the thread reports to."""

    def on_link_events(self, events: list[LinkEvent]) -> None:
        """Take what the link saw; called on the link's thread."""

    def on_stun_event(self, interface: InterfaceName, event: StunEvent) -> None:
        """Take what STUN found; called on the link's thread."""


class InterfaceThread:
    """One interface's thread."""

    def __init__(
        self,
        sock: socket.socket,
        link: Link,
        stun: StunClient | None,
        owner: LinkOwner,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.link = link
        self.port: int = sock.getsockname()[1]
        self._socket = sock
        self._stun = stun
        self._owner = owner
        self._clock = clock
        self._inbox: deque[LinkCommand | Callable[[StunClient], None]] = deque()
        self._waiter = Waiter(sock.fileno(), clock)
        self._unsent: deque[tuple[Address, bytes]] = deque()
        self._path_log = PathLog()
        self._stopping = False
        self._thread = threading.Thread(target=self._run, name=f"plr-{link.identity.interface}", daemon=True)

    @property
    def interface(self) -> InterfaceName:
        """The interface this thread owns."""
        return self.link.identity.interface

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def stop(self, timeout_s: float) -> None:
        """End the thread after what is queued has left, and close the socket."""
        self._stopping = True
        self.wake()
        self._thread.join(timeout_s)
        if self._thread.is_alive():
            log.warning("%s: the thread did not end within %.1f s", self.interface, timeout_s)

    def post(self, command: LinkCommand | Callable[[StunClient], None]) -> None:
        """Queue a command for the link (or a call on the STUN client); follow it with `wake`."""
        if len(self._inbox) >= MAX_INBOX:
            self.link.stats.dropped["inbox_full"] += 1
            return
        self._inbox.append(command)

    def wake(self) -> None:
        """Make the thread look at its inbox; nearly free while it is awake."""
        self._waiter.wake()

    # Runs on the thread ------------------------------------------------------------------------------------------

    def _run(self) -> None:
        waiter = self._waiter
        try:
            while not self._stopping:
                waiter.wait(self._due(), for_room=bool(self._unsent))
                self._guarded_turn()
            self._guarded_turn()
        finally:
            waiter.close()
            self._socket.close()

    def _guarded_turn(self) -> None:
        try:
            self._turn()
        except Exception:
            # One interface's bug must not silence the interface for good, nor hide.
            log.exception("%s: internal error; the interface goes on", self.interface)
            self.link.stats.dropped["internal_error"] += 1
            time.sleep(ERROR_PAUSE_S)

    def _due(self) -> float:
        """When a turn is wanted without anybody asking for it."""
        due = self.link.next_timer()
        if self._stun is not None:
            stun_due = self._stun.next_timer()
            if stun_due is not None:
                due = min(due, stun_due)
        return max(due, self._clock() + BLOCKED_TIMER_S) if self._unsent else due

    def _turn(self) -> None:
        link, clock = self.link, self._clock
        self._receive()
        self._execute()
        link.handle_timer(clock())
        self._exchange()
        self._stun_turn()
        while not self._unsent:
            datagrams = link.datagrams_to_send(clock())
            if not datagrams:
                break
            self._unsent.extend(datagrams)
            self._flush()
            self._exchange()
        else:
            self._flush()

    def _receive(self) -> None:
        sock, link, stun = self._socket, self.link, self._stun
        for _ in range(RECEIVE_BATCH):
            try:
                data, source = sock.recvfrom(RECEIVE_BYTES)
            except BlockingIOError:
                return
            except OSError as error:
                # ICMP errors of earlier sends surface here; the paths' own probes judge.
                link.stats.dropped[f"receive_{errno.errorcode.get(error.errno or 0, 'error').lower()}"] += 1
                continue
            address = normalise(source)
            if len(data) <= MAX_DATAGRAM_BYTES and data[:1] and data[0] >= FIRST_BYTE & 0xF0:
                link.receive_datagram(data, address, self._clock())
            elif stun is not None and stun.receive_datagram(data, address, self._clock()):
                link.stats.datagrams["received", "stun"] += 1
            else:
                link.stats.dropped["malformed"] += 1

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

    def _exchange(self) -> None:
        """Hand events to the engine until neither side has more for the other."""
        link = self.link
        while True:
            events = []
            while (event := link.next_event()) is not None:
                events.append(event)
            if events:
                self._owner.on_link_events(events)
                for event in events:
                    if isinstance(event, PathChanged):
                        self._path_log.note(event)
            if not self._inbox and not events:
                return
            self._execute()

    def _stun_turn(self) -> None:
        stun = self._stun
        if stun is None:
            return
        stun.handle_timer(self._clock())
        for data, address in stun.datagrams_to_send():
            self._send(data, address)
            self.link.stats.datagrams["sent", "stun"] += 1
        while (event := stun.next_event()) is not None:
            self._owner.on_stun_event(self.interface, event)

    def _flush(self) -> None:
        unsent = self._unsent
        while unsent:
            address, data = unsent[0]
            if not self._send(data, address):
                return
            unsent.popleft()

    def _send(self, data: bytes, address: Address) -> bool:
        """Send one datagram; False when the socket's buffer is full and it must wait."""
        destination = to_sockaddr(self._socket.family, address)
        if destination is None:
            return True
        try:
            self._socket.sendto(data, destination)
        except BlockingIOError:
            self.link.stats.dropped["send_buffer_full_waits"] += 1
            return False
        except OSError as error:
            self.link.stats.dropped[f"unsendable_{errno.errorcode.get(error.errno or 0, 'error').lower()}"] += 1
        return True
