"""Handles path MTU for one link: starts the search, informs the engine, hands back what is too long."""

from __future__ import annotations

from typing import TYPE_CHECKING

from plr.sidecar.core.base.values import PathState
from plr.sidecar.core.path.pmtu import payloads
from plr.sidecar.core.seam.links import FragmentsLost, PathMtuChanged
from plr.sidecar.core.wire.frame import BASE_BYTES

if TYPE_CHECKING:
    from collections import deque
    from collections.abc import Iterable

    from plr.sidecar.core.path.in_flight import Sent
    from plr.sidecar.core.path.path import Path
    from plr.sidecar.core.seam.links import LinkEvent

DEFAULT_MTU = 1500
"""Ethernet's MTU in bytes, used until the interface's own is known."""


class LinkMtu:
    """The MTU of one interface, and its effect on the link's paths."""

    __slots__ = ("_events", "_mtu")

    def __init__(self, events: deque[LinkEvent]) -> None:
        self._events = events
        self._mtu = DEFAULT_MTU

    def set_interface(self, mtu: int, paths: Iterable[Path], now: float) -> None:
        """Set the interface's MTU in bytes, IP header included."""
        self._mtu = mtu
        for path in paths:
            if path.state is not PathState.DOWN:
                self.search(path, now)

    def search(self, path: Path, now: float) -> None:
        """Look for the longest datagram that a path, which is up, carries."""
        if path.remote is not None and path.mtu.start(payloads(self._mtu, ipv6=":" in path.remote[0]), now):
            self._fell(path)

    def start_afresh(self, path: Path) -> None:
        """Forget the path's size; the search begins when it is up."""
        if path.mtu.stop():
            self._fell(path)

    def route_changed(self, path: Path, now: float) -> None:
        """Search again if a search began: the peer's datagrams come by another route."""
        if path.mtu.timer is not None:
            self.start_afresh(path)
            self.search(path, now)

    def answered(self, path: Path, probe_id: int, now: float) -> bool:
        """Take a PROBE_REPLY; return False if it answers no MTU probe."""
        before = path.mtu.size
        answers = path.mtu.on_reply(probe_id, now)
        if path.mtu.size != before:
            self._events.append(PathMtuChanged(path.id, path.mtu.size))
        return answers

    def lost(self, path: Path, lost: list[Sent], now: float) -> None:
        """Note datagrams that were found lost at once; call it before they are sent again."""
        # Those longer than the current size left before it fell, and say nothing about what is sent now.
        large = sum(run.within(BASE_BYTES + 1, path.mtu.size) for run in lost)
        if large and path.mtu.on_lost(large, now):
            self._fell(path)

    def too_big(self, path: Path, size: int, now: float) -> None:
        """Note that the kernel refused to send a datagram of this many bytes over the interface."""
        if path.mtu.on_too_big(size, now):
            self._fell(path)

    def _fell(self, path: Path) -> None:
        """Hand back what waits in datagrams too long for the path; those in flight get lost."""
        self._events.append(PathMtuChanged(path.id, path.mtu.size))
        for message, indices in path.queue.clear():
            if message.datagram_bytes <= path.mtu.size:
                path.queue.resend(message, indices)
            else:
                self._events.append(FragmentsLost(path.id, message, indices))
