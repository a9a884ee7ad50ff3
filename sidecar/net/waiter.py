"""Waiting on one thread for a socket, for a time and for other threads, with as few system calls as it takes."""

from __future__ import annotations

import os
import select
import weakref
from typing import TYPE_CHECKING

from sidecar.net.timerfd import NEVER, Timer

if TYPE_CHECKING:
    from collections.abc import Callable


EARLY_S = 0.001
"""A wait may end this much early, rather than that the timer is set again."""


class Waiter:
    """One thread waits by it, any thread may wake that one.

    A wake-up of a sleeping thread costs the waker a system call and the machine a handover (about 0.1 to 0.3 ms of
    latency on an idle virtual machine); `wake` therefore writes only to a thread that sleeps, and only once.
    """

    def __init__(self, socket_fd: int, clock: Callable[[], float]) -> None:
        """`clock` must be CLOCK_MONOTONIC, which the kernel's timer runs on. Raises OSError without free files."""
        self.wakes = 0
        """Times that a sleeping thread was woken by another one."""
        self._socket_fd = socket_fd
        self._clock = clock
        self._timer = Timer()
        self._wake_fd = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
        # Closed with the object, not with the thread: whoever still holds it may wake it, and must not hit another
        # file that got the same number.
        weakref.finalize(self, os.close, self._wake_fd)
        self._poller = select.epoll()
        self._poller.register(socket_fd, select.EPOLLIN)
        # Edge-triggered: each expiry and each write is told once, and nothing need be read.
        self._poller.register(self._timer.fd, select.EPOLLIN | select.EPOLLET)
        self._poller.register(self._wake_fd, select.EPOLLIN | select.EPOLLET)
        self._for_room = False
        self._asleep = False
        self._called = False

    def wake(self) -> None:
        """End the wait, or the next one if the thread is awake; from any thread, for free on the waiting one."""
        # In this order: the sleeper announces its sleep first and looks at `_called` after, so that one of both sees
        # the other. (Each of these is one step for the interpreter.)
        self._called = True
        if self._asleep:
            self._asleep = False
            self.wakes += 1
            os.eventfd_write(self._wake_fd, 1)

    def looked(self) -> None:
        """The thread is about to look at what others left for it: their calls until now need not end a wait."""
        self._called = False

    def wait(self, due: float, *, for_room: bool = False) -> bool:
        """Wait until the socket is readable, `due` (s) has come (EARLY_S early at times), or somebody wakes us.

        With `for_room` also until the socket takes datagrams again. Returns whether there is anything to receive.
        """
        if for_room != self._for_room:
            self._for_room = for_room
            events = select.EPOLLIN | select.EPOLLOUT if for_room else select.EPOLLIN
            self._poller.modify(self._socket_fd, events)
        if due <= self._clock():
            return self._poll(0.0)
        # Also to put it off: an acknowledgement that came makes most times superfluous, and to set the timer costs less
        # than to wake up for nothing.
        if not due - EARLY_S <= self._timer.due <= due:
            self._timer.arm(due)
        self._asleep = True
        readable = self._poll(0.0 if self._called else None)
        self._asleep = False
        return readable

    def close(self) -> None:
        """Wait no more; `wake` stays harmless."""
        self._poller.close()

    def _poll(self, timeout_s: float | None) -> bool:
        readable = False
        for fd, events in self._poller.poll(timeout_s):
            if fd == self._timer.fd:
                self._timer.due = NEVER
            elif fd == self._socket_fd:
                readable = events != select.EPOLLOUT  # an error has to be taken from the socket, too
        return readable
