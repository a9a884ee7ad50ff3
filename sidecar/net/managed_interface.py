"""Manages one interface in use: its thread, its known addresses, and whether it can carry anything now.

It lives as long as the interface. Without carrier or address it is only suspended: socket, packet numbers and what
the peers know about it remain valid, so that it carries again at once when it is back.
"""

from __future__ import annotations

import logging
import random
import time
from functools import partial
from typing import TYPE_CHECKING

from plr.protos.model.members import Candidate, CandidateKind
from plr.sidecar.core.control.ways import families_in_turn
from plr.sidecar.core.link.link import Link
from plr.sidecar.core.path.pmtu import LEAST_MTU
from plr.sidecar.core.seam.links import SetCarrier, SetMtu, SetReady
from plr.sidecar.core.stun.client import StunClient
from plr.sidecar.net.interface_thread import InterfaceThread
from plr.sidecar.net.sockets import BoundTo, open_socket

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from plr.protos.model.ids import Address, InterfaceName
    from plr.sidecar.core.link.memory import LinkMemory
    from plr.sidecar.core.link.sender import LinkIdentity
    from plr.sidecar.core.path.key_exchange import KeyLimits
    from plr.sidecar.core.seam.links import Rebind
    from plr.sidecar.core.stun.events import StunEvent
    from plr.sidecar.net.interface_thread import LinkOwner
    from plr.sidecar.net.interfaces import Interface

STOP_TIMEOUT_S = 1.0

log = logging.getLogger(__name__)


class ManagedInterface:
    """An interface, its socket and its thread. Used by the manager; `reflexive` and `interface` under its lock."""

    def __init__(
        self,
        interface: Interface,
        port: int,
        identity: LinkIdentity,
        memory: LinkMemory | None,
        limits: KeyLimits,
        stun_servers: Iterable[Address] | None,
        owner: LinkOwner,
        on_stun: Callable[[InterfaceName, StunEvent], None],
    ) -> None:
        """Open the socket, which may raise OSError. `stun_servers` is None when STUN is off.

        The interface's thread reports to `owner`, and STUN events to `on_stun`.
        """
        self.interface = interface
        self.suspended = False
        self.reflexive: dict[int, Address] = {}
        """Family -> the address at which STUN servers see it."""
        opened = open_socket(interface, port)
        self.bound_to = opened.bound_to
        self._bound_address = opened.socket.getsockname()[0] if opened.bound_to is BoundTo.ADDRESS else None
        link = Link(identity, random.SystemRandom(), time.monotonic(), memory, limits)
        stun = None
        if stun_servers is not None:
            stun = StunClient(stun_servers, random.SystemRandom(), drops=link.stats.dropped)
            stun.start(time.monotonic())
        self.thread = InterfaceThread(opened.socket, link, stun, owner, partial(on_stun, interface.name))
        self._tell_mtu(interface)

    @property
    def name(self) -> InterfaceName:
        """Return the interface's name."""
        return self.interface.name

    def must_reopen(self, interface: Interface) -> bool:
        """Return whether the socket no longer fits the interface: it is another device, or its address is gone."""
        if interface.index != self.interface.index:
            return True
        return self._bound_address is not None and self._bound_address not in interface.addresses

    def suspend(self, reason: str) -> None:
        """Take its paths down at once, as it can carry nothing for this reason."""
        self.suspended = True
        self._post(SetCarrier(on=False, why_not=reason))

    def update(self, interface: Interface) -> bool:
        """Take the interface as it is now; return whether anything changed for its peers."""
        before, self.interface = self.interface, interface
        was_suspended, self.suspended = self.suspended, False
        rebind = interface.rebound_since(before)
        if was_suspended:
            self._post(SetCarrier(on=True))
        if rebind is not None:
            self._post(rebind)
        if interface.mtu != before.mtu:
            self._tell_mtu(interface)
        changed = was_suspended or rebind is not None
        if changed:
            # Learned on an older network; the current address comes within a round trip.
            self.reflexive.clear()
            self.thread.post(lambda stun: stun.start(time.monotonic()))
            self.thread.wake()
        return changed

    def _tell_mtu(self, interface: Interface) -> None:
        if 0 < interface.mtu < LEAST_MTU:
            text = "%s: its MTU of %d is below %d: requests of more than a few hundred bytes do not get through"
            log.warning(text, interface.name, interface.mtu, LEAST_MTU)
        self._post(SetMtu(interface.mtu))

    def set_ready(self) -> None:
        """Let it be used."""
        self._post(SetReady(ready=True))

    def set_stun_servers(self, servers: tuple[Address, ...]) -> None:
        """Ask these servers from now on."""
        self.thread.post(lambda stun: stun.set_servers(servers, time.monotonic()))
        self.thread.wake()

    def candidates(self, advertised: Iterable[str]) -> list[Candidate]:
        """Return where peers may reach it, the best first; nowhere while it is suspended.

        The order is: the operator's `advertised` addresses, those that STUN saw, its own with alternating families.
        """
        if self.suspended:
            return []
        number, port = self.thread.link.identity.interface_id, self.thread.port
        own = families_in_turn([(address, port) for address in self.interface.addresses])
        kinds = dict.fromkeys(((address, port) for address in advertised), CandidateKind.HOST)
        for address in self.reflexive.values():
            if address not in own:
                kinds.setdefault(address, CandidateKind.SERVER_REFLEXIVE)
        kinds |= dict.fromkeys(own, CandidateKind.HOST)
        return [Candidate(number, self.name, kind, address) for address, kind in kinds.items()]

    def stop(self) -> LinkMemory:
        """End the thread; return what the interface's next link must know."""
        ended = self.thread.stop(STOP_TIMEOUT_S)
        return self.thread.link.remember(hangs=not ended)

    def _post(self, command: SetCarrier | Rebind | SetMtu | SetReady) -> None:
        self.thread.post(command)
        self.thread.wake()
