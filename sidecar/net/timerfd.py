"""Wraps a kernel timer as a file descriptor (timerfd_create(2)), which Python 3.11 lacks.

epoll's own timeout counts whole milliseconds. Gain over it: docs/develop/adr/0004-threads-and-one-lock.md.
"""

from __future__ import annotations

import ctypes
import os
import time
import weakref

from plr.sidecar.core.base.timers import NEVER

_NANOSECONDS = 1_000_000_000
_EARLIEST_S = 1e-6
"""Earliest time: a timer set to 0 would be disarmed."""
_LATEST_S = 1e9
"""Latest time, thirty years from boot: keeps a far timer inside a 32-bit time_t."""
_TFD_TIMER_ABSTIME = 1

# PyDLL keeps the interpreter's lock: setting a timer never blocks, and a handover costs more than the call.
_libc = ctypes.PyDLL(None, use_errno=True)
_timerfd_create = _libc.timerfd_create
_timerfd_create.argtypes = (ctypes.c_int, ctypes.c_int)
_timerfd_settime = _libc.timerfd_settime
_timerfd_settime.argtypes = (ctypes.c_int, ctypes.c_int, ctypes.c_void_p, ctypes.c_void_p)


class Timer:
    """One timer on the clock of time.monotonic(); its `fd` is readable (or its `wait` returns) once it has fired."""

    __slots__ = ("__weakref__", "_spec", "due", "fd")

    def __init__(self) -> None:
        """Create the timer; raises OSError when the process has no file descriptor left."""
        self.fd: int = _timerfd_create(time.CLOCK_MONOTONIC, os.O_CLOEXEC)
        if self.fd < 0:
            raise _last_error("timerfd_create")
        # Closed with the object: a thread that still holds it must not set another file's timer.
        weakref.finalize(self, os.close, self.fd)
        self.due = NEVER
        """When it fires (s); NEVER when it is not armed. A thread that sees it fire sets it to NEVER."""
        self._spec = (ctypes.c_long * 4)()  # struct itimerspec: interval, then value; seconds and nanoseconds each

    def arm(self, due: float) -> None:
        """Arm the timer for `due` (s), at once when that has passed, instead of its earlier time."""
        # Rounded up: a timer that fires early would have to be armed again.
        nanoseconds = int(min(max(due, _EARLIEST_S), _LATEST_S) * _NANOSECONDS) + 1
        self._spec[2], self._spec[3] = divmod(nanoseconds, _NANOSECONDS)
        if _timerfd_settime(self.fd, _TFD_TIMER_ABSTIME, self._spec, None) < 0:
            raise _last_error("timerfd_settime")
        self.due = due

    def arm_at_latest(self, due: float) -> None:
        """Arm the timer for `due` (s) or before: no system call when it is armed for an earlier time already."""
        if due < self.due:
            self.arm(due)

    def wait(self) -> None:
        """Sleep until it fires; another thread may arm it meanwhile."""
        os.read(self.fd, 8)
        self.due = NEVER


def _last_error(call: str) -> OSError:
    number = ctypes.get_errno()
    return OSError(number, f"{call}: {os.strerror(number)}")
