"""Finds interfaces that are no help to their robot although they are up: no alert on its requests tells of them while
another interface makes up for them.

- A *flapping* interface: a path over it goes up and down all the time. If paths to the same server do so over another
  interface too, and this one has a steady path to another server, then the server is to blame.
- A *useless* interface: a path over it is up, but a request over any of its paths would miss the deadline, or most
  probes are lost. This holds only if another interface does much better. Otherwise it may be the servers, and the
  robot's requests tell of it anyway.

Nothing here decides where requests go. Times are monotonic seconds.
"""

from __future__ import annotations

from collections import Counter, deque
from dataclasses import dataclass, field
from itertools import islice
from typing import TYPE_CHECKING

from plr.controlplane.core.estimate.network import MAX_PATH_CHANGES
from plr.protos.model.status import Fault, InterfaceFault

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Mapping

    from plr.controlplane.core.estimate.network import PathRecord
    from plr.controlplane.core.problem.problem import Block
    from plr.protos.model.ids import InterfaceName, NodeName

FLAP_WINDOW_S = 300.0
"""Changes of a path (up or down) count for this long."""

FLAPS = 6
"""Changes within that time from which an interface counts as flapping: three outages. A tunnel makes one."""

STEADY = 3
"""Changes below which it no longer does."""

LOST_SHARE = 0.5
"""Share of lost probes, or of lost datagrams, above which a path is of no use."""

MISS_PROBABILITY = 0.8
"""Probability to miss the deadline from which a path is of no use for a service: what probes alone show of a path that
is always too late is just above this."""

GOOD_PROBABILITY = 0.5
"""Probability to miss up to which another interface counts as much better."""

LEAST_PROBES = 5.0
"""Probes, or datagrams, below which nothing is known of what a path loses."""

USELESS_AFTER_S = 60.0
"""Time for which an interface has to be of no use, or of use again, before it counts as that."""

LOOK_EVERY_S = 10.0
"""Least time between two looks at a robot: one takes up to a millisecond for the largest tables."""

MAX_PATHS_LOOKED_AT = 512
"""Paths, and blocks, of one robot that are looked at; of the paths, as many over each interface."""

MAX_WATCHED_INTERFACES = 256
"""Interfaces of one robot that are watched. Beyond that, one that is well and did not come or go lately is forgotten.
If there is none, the others are counted as left out, and have no faults."""


@dataclass(slots=True)
class _Watch:
    """What is known of one interface."""

    links: deque[float] = field(default_factory=lambda: deque(maxlen=MAX_PATH_CHANGES))
    """When the robot announced it, or withdrew it."""
    link_changes: int = 0
    flapping: bool = False
    useless: bool = False
    otherwise_since: float | None = None
    """Since when it has been of no use, or of use, other than `useless` says."""
    texts: dict[Fault, str] = field(default_factory=dict)
    """Details of the faults that it has."""

    def is_calm(self, now: float) -> bool:
        """Return whether nothing is wrong with it, and it did not come or go lately."""
        return not self.texts and (not self.links or self.links[-1] < now - FLAP_WINDOW_S)


@dataclass(slots=True)
class _Robot:
    looked_at: float
    interfaces: dict[InterfaceName, _Watch] = field(default_factory=dict)
    restless: frozenset[NodeName] = frozenset()


@dataclass(frozen=True, slots=True)
class FaultChange:
    """An interface has a fault, or (`over`) no longer has it."""

    found: InterfaceFault
    over: bool


class Faults:
    """The faults of the interfaces of all registered robots."""

    def __init__(self) -> None:
        self._robots: dict[NodeName, _Robot] = {}
        self.left_out = 0
        """Times that something was noted of an interface beyond those watched."""

    def forget(self, robot: NodeName) -> None:
        """Forget a robot: it is gone, or has restarted."""
        self._robots.pop(robot, None)

    def note_links(self, robot: NodeName, changed: Iterable[InterfaceName], now: float) -> None:
        """Note that a robot announced interfaces that it had not, or withdrew them."""
        for interface in changed:
            if (watch := self._watch(robot, interface, now)) is not None:
                watch.links.append(now)
                watch.link_changes += 1

    def link_changes(self, robot: NodeName, interface: InterfaceName) -> int:
        """Return how often the interface was announced or withdrawn since the robot is known."""
        known = self._robots.get(robot)
        watch = known.interfaces.get(interface) if known is not None else None
        return watch.link_changes if watch is not None else 0

    def of(self, robot: NodeName, interfaces: Collection[InterfaceName]) -> tuple[InterfaceFault, ...]:
        """Return what is wrong with these interfaces of a robot."""
        known = self._robots.get(robot)
        if known is None:
            return ()
        return tuple(
            InterfaceFault(interface, fault, text)
            for interface, watch in known.interfaces.items()
            if interface in interfaces
            for fault, text in watch.texts.items()
        )

    def restless_servers(self, robot: NodeName) -> frozenset[NodeName]:
        """Return the servers to blame for what goes up and down on a robot's interfaces."""
        known = self._robots.get(robot)
        return known.restless if known is not None else frozenset()

    def is_due(self, robot: NodeName, now: float) -> bool:
        """Return whether a robot may be looked at again."""
        known = self._robots.get(robot)
        return known is None or now - known.looked_at >= LOOK_EVERY_S

    def look(
        self,
        robot: NodeName,
        paths: Mapping[tuple[InterfaceName, NodeName], PathRecord],
        blocks: Iterable[Block],
        now: float,
    ) -> list[FaultChange]:
        """Look at a robot that reported: `paths` to servers that are there, and the `blocks` of its services.

        Return what has changed.
        """
        known = self._robots.setdefault(robot, _Robot(now))
        known.looked_at = now
        looked_at = _some_of_each_interface(paths)
        changes, known.restless = _changes(looked_at, now - FLAP_WINDOW_S)
        misses = _misses(islice(blocks, MAX_PATHS_LOOKED_AT))
        useless = _useless(looked_at, misses, now)
        found: list[FaultChange] = []
        for interface in changes:
            self._watch(robot, interface, now)
        for interface, watch in known.interfaces.items():
            count = max(changes.get(interface, 0), sum(at >= now - FLAP_WINDOW_S for at in watch.links))
            found += _judge_flapping(interface, watch, count)
            found += _judge_useless(interface, watch, useless.get(interface), now)
        return found

    def _watch(self, robot: NodeName, interface: InterfaceName, now: float) -> _Watch | None:
        known = self._robots.setdefault(robot, _Robot(now - LOOK_EVERY_S))
        watch = known.interfaces.get(interface)
        if watch is None:
            if len(known.interfaces) >= MAX_WATCHED_INTERFACES:
                calm = next((name for name, one in known.interfaces.items() if one.is_calm(now)), None)
                if calm is None:
                    self.left_out += 1
                    return None
                del known.interfaces[calm]
            watch = known.interfaces[interface] = _Watch()
        return watch


def _some_of_each_interface(
    paths: Mapping[tuple[InterfaceName, NodeName], PathRecord],
) -> Mapping[tuple[InterfaceName, NodeName], PathRecord]:
    """Return at most about MAX_PATHS_LOOKED_AT of the paths, as many over each interface."""
    if len(paths) <= MAX_PATHS_LOOKED_AT:
        return paths
    left = dict.fromkeys((interface for interface, _ in paths), 0)
    most = max(1, MAX_PATHS_LOOKED_AT // len(left))
    chosen = {}
    for key, path in paths.items():
        if left[key[0]] < most:
            left[key[0]] += 1
            chosen[key] = path
    return chosen


def _judge_flapping(interface: InterfaceName, watch: _Watch, count: int) -> list[FaultChange]:
    before = watch.flapping
    watch.flapping = count >= (STEADY if before else FLAPS)
    least = "at least " if count >= MAX_PATH_CHANGES else ""
    text = f"it, or a path over it, went up or down {least}{count} times in the last {FLAP_WINDOW_S / 60:.0f} min"
    return _judged(interface, watch, Fault.FLAPPING, before, watch.flapping, text)


def _judge_useless(interface: InterfaceName, watch: _Watch, text: str | None, now: float) -> list[FaultChange]:
    before = watch.useless
    if (text is not None) == before:
        watch.otherwise_since = None
    elif watch.otherwise_since is None:
        watch.otherwise_since = now
    elif now - watch.otherwise_since >= USELESS_AFTER_S:
        watch.useless, watch.otherwise_since = not before, None
    kept = text or watch.texts.get(Fault.USELESS, "")
    return _judged(interface, watch, Fault.USELESS, before, watch.useless, kept)


def _judged(
    interface: InterfaceName, watch: _Watch, fault: Fault, before: bool, present: bool, text: str
) -> list[FaultChange]:
    if present:
        watch.texts[fault] = text
    else:
        watch.texts.pop(fault, None)
    return [FaultChange(InterfaceFault(interface, fault, text), over=before)] if present != before else []


def _changes(
    paths: Mapping[tuple[InterfaceName, NodeName], PathRecord], since: float
) -> tuple[dict[InterfaceName, int], frozenset[NodeName]]:
    """Return how often the most restless path over each interface went up or down, apart from those to servers that
    are to blame themselves; and these servers."""
    counts = {key: path.changes_since(since) for key, path in paths.items()}
    restless = {key for key, count in counts.items() if count >= STEADY}
    interfaces_of_server = Counter(server for _, server in restless)
    steady_over = {key[0] for key, path in paths.items() if path.up and key not in restless}
    found = dict.fromkeys((interface for interface, _ in paths), 0)
    blamed: set[NodeName] = set()
    for (interface, server), count in counts.items():
        if (interface, server) in restless and interfaces_of_server[server] > 1 and interface in steady_over:
            if count >= FLAPS:
                blamed.add(server)
        else:
            found[interface] = max(found[interface], count)
    return found, frozenset(blamed)


def _misses(blocks: Iterable[Block]) -> dict[InterfaceName, float]:
    """Return the lowest probability to miss a deadline over each interface, of all services and servers."""
    found: dict[InterfaceName, float] = {}
    for block in blocks:
        for interface, row in zip(block.interfaces, block.epsilon, strict=True):
            for epsilon in row:
                if epsilon is not None and epsilon < found.get(interface, 2.0):
                    found[interface] = epsilon
    return found


def _useless(
    paths: Mapping[tuple[InterfaceName, NodeName], PathRecord], misses: Mapping[InterfaceName, float], now: float
) -> dict[InterfaceName, str]:
    """Return why interfaces are of no use now, for those that are."""
    lost: dict[InterfaceName, float] = {}
    up: set[InterfaceName] = set()
    for (interface, _), path in paths.items():
        if not path.up:
            continue
        up.add(interface)
        if max(path.rtt.weight(now), path.datagrams.weight(now)) >= LEAST_PROBES:
            lost[interface] = min(lost.get(interface, 1.0), path.loss())
    bad: dict[InterfaceName, str] = {}
    good = False
    for interface in up:
        lost_share, miss = lost.get(interface, 0.0), misses.get(interface)
        if lost_share > LOST_SHARE:
            bad[interface] = f"it is up, but the best path over it loses {lost_share:.0%} of what is sent"
        elif miss is not None and miss >= MISS_PROBABILITY:
            bad[interface] = f"it is up, but a request over it would miss its deadline with a probability of {miss:.0%}"
        elif interface in lost or miss is not None:
            good = good or miss is None or miss <= GOOD_PROBABILITY
    return bad if good else {}
