"""Waits on one thread for a socket, a time and other threads, with as few system calls as possible."""

from __future__ import annotations

import os
import select
import weakref
from typing import TYPE_CHECKING

from plr.sidecar.core.base.timers import NEVER
from plr.sidecar.net.timerfd import Timer

if TYPE_CHECKING:
    from collections.abc import Callable


EARLY_S = 0.001
"""A wait may end this much early, which saves setting the timer again."""


class Waiter:
    """Lets one thread wait, and any thread wake it.

    Waking a sleeping thread costs the waker a system call and the machine a handover (about 0.1 to 0.3 ms of latency
    on an idle virtual machine); `wake` therefore writes only to a thread that sleeps, and only once.
    """

    def __init__(self, socket_fd: int, clock: Callable[[], float]) -> None:
        """Wait for `socket_fd`; `clock` must be CLOCK_MONOTONIC, as the kernel's timer is. Raises OSError without free
        files."""
        self.wakes = 0
        """Number of times that the sleeping thread was woken by another one."""
        self._socket_fd = socket_fd
        self._clock = clock
        self._timer = Timer()
        self._wake_fd = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
        # Closed with the object, not with the thread: a thread that still holds it may wake it, and must not hit
        # another file that got the same number.
        weakref.finalize(self, os.close, self._wake_fd)
        self._poller = select.epoll()
        self._poller.register(socket_fd, select.EPOLLIN)
        # Edge-triggered: each expiry and each write is reported once, and nothing has to be read.
        self._poller.register(self._timer.fd, select.EPOLLIN | select.EPOLLET)
        self._poller.register(self._wake_fd, select.EPOLLIN | select.EPOLLET)
        self._for_room = False
        self._asleep = False
        self._called = False

    def wake(self) -> None:
        """End the wait, or the next one if the thread is awake; from any thread, free on the waiting one."""
        # In this order: the sleeper announces its sleep first and looks at `_called` afterwards, so that one of the two
        # sees the other. (Each of these is one step for the interpreter.)
        self._called = True
        if self._asleep:
            self._asleep = False
            self.wakes += 1
            os.eventfd_write(self._wake_fd, 1)

    def looked(self) -> None:
        """Note that the thread is about to look at what others left for it: their calls so far need not end a wait."""
        self._called = False

    def wait(self, due: float, *, for_room: bool = False) -> bool:
        """Wait until the socket is readable, `due` (s) has come (EARLY_S early at times), or somebody wakes us.

        With `for_room` also until the socket takes datagrams again. Return whether there is anything to receive.
        """
        if for_room != self._for_room:
            self._for_room = for_room
            events = select.EPOLLIN | select.EPOLLOUT if for_room else select.EPOLLIN
            self._poller.modify(self._socket_fd, events)
        if due <= self._clock():
            return self._poll(0.0)
        # Also to put it off: an acknowledgement makes most times superfluous, and setting the timer costs less than
        # waking up for nothing.
        if not due - EARLY_S <= self._timer.due <= due:
            self._timer.arm(due)
        self._asleep = True
        readable = self._poll(0.0 if self._called else None)
        self._asleep = False
        return readable

    def close(self) -> None:
        """Stop waiting; `wake` stays harmless."""
        self._poller.close()

    def _poll(self, timeout_s: float | None) -> bool:
        readable = False
        for fd, events in self._poller.poll(timeout_s):
            if fd == self._timer.fd:
                self._timer.due = NEVER
            elif fd == self._socket_fd:
                readable = events != select.EPOLLOUT  # an error also has to be read from the socket
        return readable
