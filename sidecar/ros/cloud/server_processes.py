"""Watches the processes of local servers: DDS notices that one was killed after a lease of 20 s, the kernel at once.

A separate thread waits for their ends; everything else belongs to the ROS thread.
"""

from __future__ import annotations

import logging
import os
import select
import threading
from collections import deque
from typing import TYPE_CHECKING

from plr.sidecar.ros.cloud.dds_id import pid_bits, process_of
from plr.sidecar.ros.cloud.process_finder import has_ended, open_process, wants_processor

if TYPE_CHECKING:
    from collections.abc import Callable, Collection

MAX_WATCHED = 256
"""Processes watched; each costs a file descriptor. Further ones are asked whether they live when they fall silent."""
MAX_ENDED = 1024
"""Ended processes that DDS may still believe alive; the oldest is forgotten."""
_CLOSE_TIMEOUT_S = 1.0

log = logging.getLogger(__name__)


class ServerProcesses:
    """Watches the processes behind endpoints, where they run on this host and can be identified for certain."""

    def __init__(self, domain: int, participants: Callable[[], Collection[bytes]], wake: Callable[[], None]) -> None:
        """Take `participants`, ids of all ROS processes of the domain; `wake` is called, from any thread, at an end."""
        self._domain = domain
        self._participants = participants
        self._wake = wake
        self._pidfds: dict[bytes, int | None] = {}
        """Pidfds by process; None where the process cannot be identified."""
        self._ended: dict[bytes, None] = {}
        self._events: deque[int] = deque()
        self._epoll: select.epoll | None = None
        self._stop_fd = -1
        self._thread: threading.Thread | None = None

    def watch(self, endpoint: bytes) -> None:
        """Watch for the end of the process behind `endpoint` from now on."""
        process = process_of(endpoint)
        if process in self._pidfds or process in self._ended:
            return
        watched = sum(pidfd is not None for pidfd in self._pidfds.values())
        pidfd = None
        if watched < MAX_WATCHED and not self._is_ambiguous(process):
            pidfd = open_process(endpoint, self._domain)
        self._pidfds[process] = pidfd
        if pidfd is not None:
            self._wait_for(pidfd)

    def watches(self, endpoint: bytes) -> bool:
        """Return whether the end of this endpoint's process will be noticed at once."""
        return self._pidfds.get(process_of(endpoint)) is not None

    def has_ended(self, endpoint: bytes) -> bool:
        """Return True when the endpoint's process has ended, whatever the graph says."""
        return process_of(endpoint) in self._ended

    def wants_processor(self, endpoint: bytes) -> bool:
        """Return whether the endpoint's process is known, and runs or waits for a processor."""
        pidfd = self._pidfds.get(process_of(endpoint))
        return pidfd is not None and wants_processor(pidfd)

    def take_ended(self) -> bool:
        """Note the processes that ended since the last call; return whether there are any."""
        some = False
        while self._events:
            number = self._events.popleft()
            process = next((process for process, pidfd in self._pidfds.items() if pidfd == number), None)
            # The descriptor may belong to another process by now.
            if process is None or not has_ended(number):
                continue
            self._release(process)
            if self._is_ambiguous(process):
                self._pidfds[process] = None  # perhaps the other process ended
                continue
            self._ended[process] = None
            if len(self._ended) > MAX_ENDED:
                del self._ended[next(iter(self._ended))]
            some = True
        return some

    def forget_the_gone(self) -> None:
        """Forget the processes that are gone from the graph, which shows ended ones until their lease is over."""
        wanted = {process_of(endpoint) for endpoint in self._participants()}
        for process in [process for process in self._pidfds if process not in wanted]:
            self._release(process)
        for process in [process for process in self._ended if process not in wanted]:
            del self._ended[process]

    def close(self) -> None:
        """Stop watching."""
        if self._thread is not None:
            os.eventfd_write(self._stop_fd, 1)
            self._thread.join(_CLOSE_TIMEOUT_S)
            self._thread = None
        for process in tuple(self._pidfds):
            self._release(process)
        if self._epoll is not None:
            self._epoll.close()
            os.close(self._stop_fd)
            self._epoll = None

    def _is_ambiguous(self, process: bytes) -> bool:
        """Return whether another process of the domain, perhaps in a container, has the same bits of its process id."""
        others = {process_of(endpoint) for endpoint in self._participants()} - {process}
        return any(pid_bits(other + bytes(4)) == pid_bits(process + bytes(4)) for other in others)

    def _wait_for(self, pidfd: int) -> None:
        if self._epoll is None:
            self._epoll = select.epoll()
            self._stop_fd = os.eventfd(0)
            self._epoll.register(self._stop_fd, select.EPOLLIN)
            self._thread = threading.Thread(
                target=self._run, args=(self._epoll, self._stop_fd), name="plr-servers", daemon=True
            )
            self._thread.start()
        self._epoll.register(pidfd, select.EPOLLIN | select.EPOLLONESHOT)

    def _release(self, process: bytes) -> None:
        pidfd = self._pidfds.pop(process)
        if pidfd is not None and self._epoll is not None:
            self._epoll.unregister(pidfd)
            os.close(pidfd)

    def _run(self, epoll: select.epoll, stop_fd: int) -> None:
        while True:
            for number, _ in epoll.poll():
                if number == stop_fd:
                    return
                self._events.append(number)
            self._wake()
