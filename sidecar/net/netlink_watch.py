"""Reports the kernel's announcements that links, addresses or default routes of this network namespace changed.

What exactly changed is not taken from here: announcements may be lost, so the listener scans everything
(`interfaces.list_interfaces`). One thing cannot wait for that and is read from the message itself: a link that is gone.

    nlmsghdr   0 length u32   4 type u16   6 flags u16   8 sequence u32   12 port u32
    ifinfomsg  16 family u8   18 type u16   20 index i32   24 flags u32            (RTM_NEWLINK, RTM_DELLINK)
    rtmsg      16 family u8   17 destination's length u8                           (RTM_NEWROUTE, RTM_DELROUTE)

A plain socket is used: only these fields of a message are needed, and a flood of messages must not create an object
each.
"""

from __future__ import annotations

import contextlib
import errno
import os
import select
import socket
import struct
from typing import NamedTuple

RTM_NEWLINK, RTM_DELLINK = 16, 17
RTM_NEWADDR, RTM_DELADDR = 20, 21
RTM_NEWROUTE, RTM_DELROUTE = 24, 25
# linux/rtnetlink.h RTMGRP_*: link, IPv4 and IPv6 addresses, IPv4 and IPv6 routes.
GROUPS = 0x1 | 0x10 | 0x100 | 0x40 | 0x400
_IFF_UP = 0x1
_IFF_LOWER_UP = 0x10000
_HEADER = struct.Struct("=IHHII")
_LINK = struct.Struct("=BxHiI")
_ROUTE = struct.Struct("=BB")

MESSAGE_BYTES = 32_768
"""Read buffer: the kernel's announcements are at most a page or two."""
MAX_NETLINK_MESSAGES = 64
"""Most messages read at a time: a flood must not keep its reader from everything else."""


class Changes(NamedTuple):
    """Result of one look at the announcements."""

    any: bool
    """Whether something that may matter changed, or announcements were lost."""
    gone_links: frozenset[int]
    """Indices of links that cannot carry anything now: switched off, without carrier or removed."""


class NetlinkWatch:
    """A subscription to the kernel's announcements. One thread waits; any thread may wake it."""

    def __init__(self) -> None:
        self.overruns = 0
        """Number of times the kernel had more announcements than there was room for."""
        self._wake_fd = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
        self._socket: socket.socket | None = None
        self._poller = select.poll()
        self._poller.register(self._wake_fd, select.POLLIN)

    def subscribe(self) -> None:
        """Subscribe to every change from now on. Raises OSError where the kernel or a sandbox forbids it."""
        sock = socket.socket(socket.AF_NETLINK, socket.SOCK_RAW | socket.SOCK_CLOEXEC, socket.NETLINK_ROUTE)
        try:
            sock.setblocking(False)
            sock.bind((0, GROUPS))
        except BaseException:
            sock.close()
            raise
        self._socket = sock
        self._poller.register(sock.fileno(), select.POLLIN)

    def wake(self) -> None:
        """Make `wait` return."""
        with contextlib.suppress(BlockingIOError):
            os.eventfd_write(self._wake_fd, 1)

    def wait(self, timeout_s: float) -> Changes:
        """Wait for a change, a `wake` or the timeout."""
        self._poller.poll(max(0.0, timeout_s) * 1e3)
        with contextlib.suppress(BlockingIOError):
            os.eventfd_read(self._wake_fd)
        return Changes(any=False, gone_links=frozenset()) if self._socket is None else self._read(self._socket)

    def close(self) -> None:
        """Close everything; no thread may wait or wake any more."""
        if self._socket is not None:
            self._socket.close()
        os.close(self._wake_fd)

    def _read(self, sock: socket.socket) -> Changes:
        changed = False
        gone: dict[int, bool] = {}
        for _ in range(MAX_NETLINK_MESSAGES):
            try:
                data, (port, _groups) = sock.recvfrom(MESSAGE_BYTES)
            except BlockingIOError:
                break
            except OSError as error:
                if error.errno != errno.ENOBUFS:
                    raise
                self.overruns += 1
                changed = True
                continue
            if port == 0:  # the kernel; any process may write to us
                changed |= read_announcements(data, gone)
        return Changes(changed, frozenset(index for index, is_gone in gone.items() if is_gone))


def read_announcements(data: bytes, gone: dict[int, bool]) -> bool:
    """Return whether the messages in `data` report a change that may matter; note links by index in `gone`.

    An unreadable message counts as a change: a scan of the interfaces settles it.
    """
    changed = False
    offset = 0
    while offset < len(data):
        if len(data) - offset < _HEADER.size:
            return True
        length, kind, *_ = _HEADER.unpack_from(data, offset)
        if length < _HEADER.size or offset + length > len(data):
            return True
        body = data[offset + _HEADER.size : offset + length]
        changed |= _read_message(kind, body, gone)
        offset += (length + 3) & ~3
    return changed


def _read_message(kind: int, body: bytes, gone: dict[int, bool]) -> bool:
    if kind in (RTM_NEWLINK, RTM_DELLINK):
        if len(body) >= _LINK.size:
            family, _type, index, flags = _LINK.unpack_from(body)
            if family != socket.AF_UNSPEC:
                return False  # a bridge about its ports, or IPv6 about its own settings
            gone[index] = kind == RTM_DELLINK or not (flags & _IFF_UP and flags & _IFF_LOWER_UP)
        return True
    if kind in (RTM_NEWROUTE, RTM_DELROUTE):
        # Only default routes matter here; a router's table of a million others must cost nothing.
        return len(body) < _ROUTE.size or _ROUTE.unpack_from(body)[1] == 0
    return kind in (RTM_NEWADDR, RTM_DELADDR)
