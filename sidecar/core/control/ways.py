"""Orders the ways to the control plane, each an interface and an address, in which to try them. Sans-IO.

    first     the cheapest interfaces, then dearer ones; within a price in the order of the interfaces
    then      interfaces over which the data plane hears nobody any more, and ways that failed recently
    last      no interface at all: the routing table decides, as for every other program

Only the cost of a way and whether its interface lives are known beforehand. Whether it leads to the control plane is
found out by connecting (`race.py`), whether it still does by watching what is sent (`watch.py`).
"""

from __future__ import annotations

import enum
from dataclasses import dataclass, field
from ipaddress import ip_address
from typing import TYPE_CHECKING, NamedTuple

from plr.sidecar.core.base.values import PathState

if TYPE_CHECKING:
    from collections import Counter
    from collections.abc import Iterable, Mapping, Sequence

    from plr.protos.model.ids import Address, InterfaceName

MAX_STATES = 256
"""Interfaces whose history is remembered, as many as the data plane has numbers for."""
MAX_ADDRESSES = 16
"""Addresses of the control plane that are tried: eight names of two families."""

FAILED_FIRST_S, FAILED_MAX_S = 10.0, 300.0
"""Time (s) for which a way that connects but leads to no control plane (a captive portal, say) goes to the end of the
order: longer each time, so that it does not cost an attempt at every turn."""

STAGGER_S = 0.25
"""Time between attempts (RFC 8305 section 8, Connection Attempt Delay)."""

HEAD_START_S, LIVING_HEAD_START_S = 0.5, 1.0
"""Head start of cheaper interfaces over dearer ones: longer when the data plane hears somebody over them. Both leave
time to be back within two seconds."""

WELL_S, MAX_WELL_S = 15.0, 600.0
"""A cheaper interface takes the stream back when it has been well for this long, doubled each time that a stream over
it had to be given up."""

DIAL_DROPS = (ADDRESSES_FULL, STRANGER) = ("addresses_full", "stranger")
"""Counters: addresses of the control plane beyond MAX_ADDRESSES; strangers that connect to gRPC's line."""


class Life(enum.Enum):
    """State of an interface, as the data plane knows it."""

    LIVING = "living"
    """Some path over it is up."""
    SILENT = "silent"
    """Paths over it were up; now none is."""
    UNKNOWN = "unknown"
    """No path over it has been up."""


class Price(NamedTuple):
    """Cost of the control stream over an interface; the smaller is preferred."""

    billed: bool = False
    """Whether its bytes are counted."""
    cost_per_request: float = 0.0
    """Cost of a request over it, the best guess of the cost of other traffic."""


@dataclass(frozen=True, slots=True)
class ControlInterface:
    """An interface that can carry the control stream."""

    name: InterfaceName
    addresses: frozenset[str]
    """The interface's own addresses."""
    price: Price

    def reaches(self, address: Address) -> bool:
        """Return whether it has an address of this one's family."""
        return any((":" in own) == (":" in address[0]) for own in self.addresses)


class Way(NamedTuple):
    """A way to connect."""

    interface: InterfaceName | None
    """The interface to bind to; None: the routing table decides."""
    address: Address

    def __str__(self) -> str:
        host, port = self.address
        shown = f"[{host}]:{port}" if ":" in host else f"{host}:{port}"
        return shown if self.interface is None else f"{shown} over {self.interface}"


@dataclass(frozen=True, slots=True)
class WayClass:
    """Equally good ways, in the order in which to try them."""

    ways: tuple[Way, ...]
    head_start_s: float
    """Time (s) by which the next class begins later, unless all of these have failed."""


@dataclass(slots=True)
class _InterfaceState:
    life: Life = Life.UNKNOWN
    since: float = 0.0
    well_s: float = WELL_S


@dataclass(slots=True)
class _Failure:
    until: float
    pause_s: float = field(default=FAILED_FIRST_S)


class ControlWays:
    """Everything known about the ways."""

    def __init__(self, drops: Counter[str]) -> None:
        """Start without ways; `drops` counts what is left out."""
        self._drops = drops
        self._interfaces: dict[InterfaceName, ControlInterface] = {}
        self._addresses: tuple[Address, ...] = ()
        self._states: dict[InterfaceName, _InterfaceState] = {}
        """States of all interfaces, also those that are away: coming back earns no more trust."""
        self._paths: Mapping[InterfaceName, PathState] = {}
        self._failures: dict[Way, _Failure] = {}
        self._silent: dict[Way, float] = {}
        """Way that fell silent -> until when it is avoided."""
        self._proven: Way | None = None
        self.can_bind = True
        """Whether the system lets us bind to an interface."""

    # -- inputs ---------------------------------------------------------------------------------------------------

    def set_interfaces(self, interfaces: Sequence[ControlInterface], now: float) -> None:
        """Replace the interfaces that can carry something now, in order."""
        before = self._interfaces
        self._interfaces = {interface.name: interface for interface in interfaces}
        if len(self._states) > MAX_STATES:
            self._states = {name: state for name, state in self._states.items() if name in self._interfaces}
        for name in self._interfaces:
            state = self._states.setdefault(name, _InterfaceState())
            if name not in before:
                state.life, state.since = Life.UNKNOWN, now
        self.set_paths(self._paths, now)
        self._prune()

    def set_addresses(self, addresses: Iterable[Address]) -> None:
        """Replace the addresses of the control plane, in the order of preference."""
        unique = list(dict.fromkeys(addresses))
        if len(unique) > MAX_ADDRESSES:
            self._drops[ADDRESSES_FULL] += len(unique) - MAX_ADDRESSES
        self._addresses = families_in_turn(unique)[:MAX_ADDRESSES]
        self._prune()

    def set_paths(self, best: Mapping[InterfaceName, PathState], now: float) -> None:
        """Replace the best state of the data plane's paths over each interface that has some."""
        self._paths = best
        for name in self._interfaces:
            state = self._states[name]
            path = best.get(name)
            if path is PathState.UP:
                life = Life.LIVING
            elif state.life is not Life.UNKNOWN and path is not None:
                life = Life.SILENT
            else:
                life = Life.UNKNOWN
            if life is not state.life:
                state.life, state.since = life, now
                if life is Life.LIVING:
                    self._silent = {way: until for way, until in self._silent.items() if way.interface != name}

    def failed(self, way: Way, now: float, *, whole_address: bool = False) -> None:
        """Note a way that led to no control plane; `whole_address`: over any interface."""
        address = way.address
        for one in self._ways():
            if one == way or (whole_address and one.address == address):
                before = self._failures.get(one)
                pause_s = FAILED_FIRST_S if before is None else min(2.0 * before.pause_s, FAILED_MAX_S)
                self._failures[one] = _Failure(now + pause_s, pause_s)

    def fell_silent(self, way: Way, over: InterfaceName | None, now: float) -> None:
        """Avoid a way whose connection had to be left, for a while or until its interface is heard again."""
        self._silent[way] = now + FAILED_FIRST_S
        self.disappointed(over)

    def proven(self, way: Way) -> None:
        """Note that a control plane registered us over this way."""
        self._failures.pop(way, None)
        self._silent.pop(way, None)
        self._proven = way

    def disappointed(self, name: InterfaceName | None) -> None:
        """Note that a connection over it had to be given up: the next time it must be well for longer."""
        state = None if name is None else self._states.get(name)
        if state is not None:
            state.well_s = min(2.0 * state.well_s, MAX_WELL_S)

    def held_well(self, name: InterfaceName | None) -> None:
        """Note that a connection over it has lived for long."""
        state = None if name is None else self._states.get(name)
        if state is not None:
            state.well_s = WELL_S

    # -- queries --------------------------------------------------------------------------------------------------

    @property
    def empty(self) -> bool:
        """Return whether no address is known."""
        return not self._addresses

    def life(self, name: InterfaceName | None) -> Life:
        """Return the state of an interface."""
        state = None if name is None else self._states.get(name)
        return Life.UNKNOWN if state is None else state.life

    def silent_since(self, name: InterfaceName | None) -> float | None:
        """Return since when the data plane hears nobody over it but somebody over another interface; None if not so."""
        state = None if name is None else self._states.get(name)
        if state is None or state.life is not Life.SILENT or not self._others_live(name):
            return None
        return state.since

    def has(self, name: InterfaceName) -> bool:
        """Return whether it can carry anything now."""
        return name in self._interfaces

    def owner(self, address: str) -> InterfaceName | None:
        """Return the interface that has this address."""
        return next((one.name for one in self._interfaces.values() if address in one.addresses), None)

    def another(self, over: InterfaceName | None, now: float) -> Life | None:
        """Return the state of the best other interface that may lead there as well; None if there is none."""
        lives = [
            self.life(way.interface)
            for way in self._ways()
            if way.interface not in (None, over) and self._is_good(way, now)
        ]
        if not lives:
            return None
        return Life.LIVING if Life.LIVING in lives else Life.UNKNOWN

    def classes(self, now: float) -> list[WayClass]:
        """Return all ways, the best class first."""
        good: dict[Price, list[Way]] = {}
        doubtful: list[Way] = []
        unbound: list[Way] = []
        for way in self._ways():
            if way.interface is None:
                unbound.append(way)
            elif self._is_good(way, now):
                good.setdefault(self._interfaces[way.interface].price, []).append(way)
            else:
                doubtful.append(way)
        # Other programs accept where the routing table leads: here a way that failed comes after one that did not.
        unbound.sort(key=lambda way: self._has_failed(way, now))
        found = [WayClass(tuple(good[price]), self._head_start_s(good[price])) for price in sorted(good)]
        found += [WayClass(tuple(ways), HEAD_START_S) for ways in (doubtful, unbound) if ways]
        return found

    def better(self, over: InterfaceName | None, now: float) -> list[Way]:
        """Return the ways over cheaper interfaces that have been well for long enough to take the stream back."""
        return [way for at, way in self._cheaper(over) if at <= now]

    def next_better(self, over: InterfaceName | None, now: float) -> float | None:
        """Return when `better` will return more, if nothing else happens."""
        return min((at for at, _ in self._cheaper(over) if at > now), default=None)

    def _cheaper(self, over: InterfaceName | None) -> list[tuple[float, Way]]:
        """Return the ways over living interfaces that cost less than this one, and when each may be taken."""
        if over is None or over not in self._interfaces:
            return []
        found = []
        for way in self._ways():
            name = way.interface
            if name is None or self._interfaces[name].price >= self._interfaces[over].price:
                continue
            state, failure = self._states[name], self._failures.get(way)
            if state.life is Life.LIVING:
                well_at = state.since + state.well_s
                found.append((well_at if failure is None else max(well_at, failure.until), way))
        return found

    # -- internal -------------------------------------------------------------------------------------------------

    def _ways(self) -> list[Way]:
        """Return every way; the address and the interface that worked last come first."""
        last = self._proven
        addresses = sorted(self._addresses, key=lambda address: last is None or address != last.address)
        interfaces = sorted(self._interfaces.values(), key=lambda one: last is None or one.name != last.interface)
        ways = []
        for address in addresses:
            if self.can_bind and not self._is_here(address):
                ways += [Way(one.name, address) for one in interfaces if one.reaches(address)]
        return ways + [Way(None, address) for address in addresses]

    def _is_here(self, address: Address) -> bool:
        """Return whether it is this host's: a socket bound to an interface does not get there."""
        host = address[0]
        return ip_address(host).is_loopback or self.owner(host) is not None

    def _is_good(self, way: Way, now: float) -> bool:
        if self._has_failed(way, now) or now < self._silent.get(way, now):
            return False
        return self.life(way.interface) is not Life.SILENT or not self._others_live(way.interface)

    def _has_failed(self, way: Way, now: float) -> bool:
        failure = self._failures.get(way)
        return failure is not None and now < failure.until

    def _others_live(self, name: InterfaceName | None) -> bool:
        """Return whether somebody is heard over another interface: then it is not the peers that are gone."""
        return any(self._states[other].life is Life.LIVING for other in self._interfaces if other != name)

    def _head_start_s(self, ways: Sequence[Way]) -> float:
        living = any(self.life(way.interface) is Life.LIVING for way in ways)
        return LIVING_HEAD_START_S if living else HEAD_START_S

    def _prune(self) -> None:
        ways = set(self._ways())
        self._failures = {way: failure for way, failure in self._failures.items() if way in ways}
        self._silent = {way: until for way, until in self._silent.items() if way in ways}


def families_in_turn(addresses: Sequence[Address]) -> tuple[Address, ...]:
    """Return IPv4 and IPv6 addresses alternately (RFC 8305 section 4), the family of the first address first."""
    if not addresses:
        return ()
    first_is_v6 = ":" in addresses[0][0]
    same = [address for address in addresses if (":" in address[0]) == first_is_v6]
    other = [address for address in addresses if (":" in address[0]) != first_is_v6]
    mixed = []
    for index in range(max(len(same), len(other))):
        mixed += [*same[index : index + 1], *other[index : index + 1]]
    return tuple(mixed)
