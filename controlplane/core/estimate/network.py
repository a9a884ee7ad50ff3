"""Estimates what the network costs one robot's requests: from each of its interfaces to each server, by size class.

A path's own requests of the class tell best, whichever service they were for. For a path that carried few or none,
others stand in: requests over the same interface to other servers, moved by the difference of round trips (size costs
time mostly in the access network), and the path's own probes, slower by what the size costs elsewhere. A path that was
not even probed gets its round trip from its two ends: how its interface and its server compare with others.
"""

from __future__ import annotations

import math
from collections import OrderedDict, deque
from dataclasses import dataclass
from itertools import islice
from statistics import median
from typing import TYPE_CHECKING, NamedTuple, TypeVar

from plr.controlplane.core.estimate.fading import FadedCount, FadedHistogram, forget_before
from plr.controlplane.core.estimate.staleness import HeardClock
from plr.protos.base.histogram import Histogram

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    import numpy as np
    from numpy.typing import NDArray

    from plr.controlplane.core.estimate.distribution import Distribution
    from plr.protos.model.ids import InterfaceName, NodeName
    from plr.protos.model.report import LatencyReport, PathReport

    PathKey = tuple[InterfaceName, NodeName]
    CellKey = tuple[InterfaceName, NodeName, int]

K = TypeVar("K")
V = TypeVar("V")

MAX_PATHS_PER_ROBOT = 1024
"""Paths kept of one robot; the least recently reported one is evicted."""

MAX_CELLS = 1024
"""Network histograms kept of one robot, one per path and size class; the least recently reported one is evicted."""

MAX_PATH_CHANGES = 16
"""Changes of one path (up or down) whose times are kept; the oldest one is forgotten."""

NEIGHBOURS = 2
"""Other servers over the same interface whose requests are consulted: those with the most of them."""

NEIGHBOUR_REQUESTS = 20.0
"""Maximum worth of a neighbour's requests, in requests of the path itself: the servers' own networks differ."""

PROBES_REQUESTS = 5.0
"""Maximum worth of the path's probes: they are small, so they do not show how large requests spread."""

ENDS_REQUESTS = 1.0
"""Worth of a round trip that was derived from the two ends."""

SIZE_COST_REQUESTS = 20.0
"""Requests a path must have carried before its median tells what their size costs."""


class Witness(NamedTuple):
    """A source of a path's times in the network, for requests of one class."""

    requests: float
    """Its worth in requests of the path itself ..."""
    samples: float
    """... and how many samples it rests on."""
    times: Distribution
    later_s: float
    """Added to all of its times."""
    resent: float = 0.0
    """Probability that, beyond its times, something is lost and sent again ..."""
    resend_s: float = 0.0
    """... which takes this much longer."""
    itself: bool = False
    """Whether these are requests on the very path."""

    def exceeds(self, processing: Distribution | None, seconds: float) -> float:
        """Return P(network + processing > seconds)."""
        left = seconds - self.later_s
        prompt = self.times.sum_exceeds(processing, left)
        if not self.resent:
            return prompt
        return (1.0 - self.resent) * prompt + self.resent * self.times.sum_exceeds(processing, left - self.resend_s)

    def exceeds_each(self, processing: Distribution | None, seconds: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return P(network + processing > s) for each s."""
        left = seconds - self.later_s
        prompt = self.times.sums_exceed(processing, left)
        if not self.resent:
            return prompt
        return (1.0 - self.resent) * prompt + self.resent * self.times.sums_exceed(processing, left - self.resend_s)


@dataclass(frozen=True, slots=True)
class ReportedPath:
    """One path of a robot, as last reported."""

    interface: InterfaceName
    server: NodeName
    up: bool
    round_trip_s: float
    """The median, within 2 %; NaN if none is known."""
    leads_there: bool = True
    """Whether it ever was up, or nothing ever was over its interface; otherwise its being down tells nothing."""


@dataclass(slots=True)
class PathRecord:
    """Everything known of one path except its requests."""

    up: bool
    rtt: FadedHistogram
    datagrams: FadedCount
    last: PathReport
    answered: bool = False
    """Whether it ever was up."""
    changed: deque[float] | None = None
    """When it last went up or down, the latest last; None: never."""

    def changes_since(self, since: float) -> int:
        """Return how often it has gone up or down since then, at most MAX_PATH_CHANGES."""
        return sum(at >= since for at in self.changed) if self.changed is not None else 0

    def loss(self) -> float:
        """Return the lost share of what was sent, of datagrams or of probes, whichever is worse."""
        worst = 0.0
        for ratio in (self.datagrams.ratio(), self.rtt.lost_share()):
            # NaN if nothing was sent, and NaN is not larger than anything.
            if ratio > worst:
                worst = ratio
        return worst


class RobotNetwork:
    """The paths of one robot. Times are seconds."""

    def __init__(self, half_life_s: float) -> None:
        self._half_life_s = half_life_s
        self.paths: OrderedDict[PathKey, PathRecord] = OrderedDict()
        self._answered_over: set[InterfaceName] = set()
        """Interfaces over which any server ever answered."""
        self.changes: dict[InterfaceName, int] = {}
        """How often a path over each interface went up or down, of as many interfaces as paths."""
        self._cells: OrderedDict[CellKey, FadedHistogram] = OrderedDict()
        self._clocks: dict[int, HeardClock] = {}
        """One for the cells of each size class."""
        self._round_trips: dict[PathKey, float] = {}
        """Median of each path that was probed."""
        self._rows: dict[tuple[InterfaceName, int], list[CellKey]] = {}
        """The cells of each interface and size class, those with the most requests first."""
        self._size_costs: dict[tuple[InterfaceName, int], float] = {}
        self._size_costs_anywhere: dict[int, float] = {}
        self._guessed: dict[PathKey, float] = {}
        """Round trips that were not measured."""
        self._fresh = False
        """Whether these tables reflect everything merged."""
        self.most = MAX_PATHS_PER_ROBOT + MAX_CELLS
        """Number of histograms beyond which no new ones are added."""
        self.dropped = 0
        """Entries evicted, or refused, because a table was full."""

    def __len__(self) -> int:
        """Return the number of histograms kept."""
        return len(self.paths) + len(self._cells)

    def merge_path(self, path: PathReport, now: float) -> bool:
        """Add a path's report; return True if it went up or down, or is new."""
        self._fresh = False
        key = (path.interface, path.server)
        state = known = self.paths.get(key)
        if state is None:
            if not self._has_room():
                return False
            state = PathRecord(
                path.up, FadedHistogram(self._half_life_s, now), FadedCount(self._half_life_s, now), path
            )
        self._keep(self.paths, key, state, MAX_PATHS_PER_ROBOT)
        changed = known is None or known.up != path.up
        if known is not None and changed:
            self._note_change(path.interface, known, now)
        state.up = path.up
        if path.up and not state.answered:
            state.answered = True
            if len(self._answered_over) < MAX_PATHS_PER_ROBOT:
                self._answered_over.add(path.interface)
        state.last = path
        state.rtt.add(path.rtt, now)
        # Datagrams sent before the last report may be found lost only now: no more count as lost than were sent.
        state.datagrams.add(path.datagrams_sent, min(path.datagrams_lost, path.datagrams_sent), now)
        return changed

    def _note_change(self, interface: InterfaceName, path: PathRecord, now: float) -> None:
        if path.changed is None:
            path.changed = deque(maxlen=MAX_PATH_CHANGES)
        path.changed.append(now)
        if interface in self.changes or len(self.changes) < MAX_PATHS_PER_ROBOT:
            self.changes[interface] = self.changes.get(interface, 0) + 1

    def leads_there(self, key: PathKey) -> bool:
        """Return whether the path ever was up, or nothing ever was over its interface.

        A server that an interface never reached while it reached others, as another site's, is no sign of a failure.
        """
        return self.paths[key].answered or key[0] not in self._answered_over

    def merge_requests(self, report: LatencyReport, now: float) -> None:
        """Add what requests took."""
        if not (report.network.total or report.called_off.total):
            return
        self._fresh = False
        key = (report.interface, report.server, report.size_class)
        clock = self._clocks.get(report.size_class)
        if clock is None:
            clock = self._clocks[report.size_class] = HeardClock(now)
        clock.hear(now)
        cell = self._cells.get(key)
        if cell is None:
            if not self._has_room():
                return
            cell = FadedHistogram(self._half_life_s, now, clock)
        self._keep(self._cells, key, cell, MAX_CELLS)
        cell.add(report.network, now, report.called_off)

    def _has_room(self) -> bool:
        """Return whether one more histogram may be kept; count it as dropped if not."""
        if len(self) < self.most:
            return True
        self.dropped += 1
        return False

    def _keep(self, table: OrderedDict[K, V], key: K, value: V, limit: int) -> None:
        table[key] = value
        table.move_to_end(key)
        if len(table) > limit:
            table.popitem(last=False)
            self.dropped += 1

    def forget_before(self, since: float) -> None:
        """Forget what has not been reported since then."""
        kept = len(self)
        forget_before(self.paths, since, lambda path: path.rtt.at)
        forget_before(self._cells, since, lambda cell: cell.at)
        self._fresh = self._fresh and len(self) == kept

    def forget_paths(self) -> None:
        """Forget whether paths are up and what they take by now; requests still tell."""
        # Use a new table: a holder of the old one, of a robot that left, keeps what was known.
        self.paths = OrderedDict()
        self._fresh = False

    def requests(
        self, interface: InterfaceName, server: NodeName, size_class: int, now: float, *, sample: int
    ) -> Histogram:
        """Return what requests of the class took on this path; an unfaded sample counts `sample`."""
        cell = self._cells.get((interface, server, size_class))
        return cell.scaled(now, sample) if cell is not None else Histogram()

    def witnesses(self, interface: InterfaceName, server: NodeName, size_class: int, now: float) -> Iterator[Witness]:
        """Yield all that tells what requests of the class would take from the interface to the server."""
        self._refresh(now)
        key = (interface, server)
        own = self._cells.get((*key, size_class))
        requests = own.weight(now) if own is not None else 0.0
        if own is not None and requests > 0.0 and (times := own.distribution()) is not None:
            yield Witness(requests, requests, times, 0.0, itself=True)
        round_trip, measured = self._round_trip(key)
        path = self.paths.get(key)
        loss = path.loss() if path is not None else 0.0
        others = (of for of in self._rows.get((interface, size_class), ()) if of[1] != server)
        for neighbour in islice(others, NEIGHBOURS):
            times = self._cells[neighbour].distribution()
            if times is None:
                continue
            there, there_measured = self._round_trip(neighbour[:2])
            later_s = round_trip - there
            if math.isnan(later_s):
                later_s = 0.0
            beside = self.paths.get(neighbour[:2])
            more_lost = max(0.0, loss - beside.loss()) if beside is not None else loss
            samples = self._cells[neighbour].weight(now)
            if not (measured and there_measured):
                samples = min(samples, ENDS_REQUESTS)
            resend_s = 0.0 if math.isnan(round_trip) else round_trip
            yield Witness(min(samples, NEIGHBOUR_REQUESTS), samples, times, later_s, more_lost, resend_s)
        yield from self._probed(key, round_trip, loss, size_class, now)

    def _probed(self, key: PathKey, round_trip: float, loss: float, size_class: int, now: float) -> Iterator[Witness]:
        """Yield the path's probes, or those of a similar path, slower by what the size costs."""
        if math.isnan(round_trip):
            return
        path = self.paths.get(key)
        later_s = self._size_cost(key[0], size_class, now)
        samples = path.rtt.weight(now) if path is not None else 0.0
        if path is None or (answered := path.rtt.answered()) is None:
            samples = ENDS_REQUESTS
            alike = min(self._round_trips, key=lambda other: (other[0] != key[0], other[1] != key[1], other))
            path = self.paths[alike]
            answered = path.rtt.answered()
            later_s += round_trip - self._round_trips[alike]
        if answered is not None:
            yield Witness(min(samples, PROBES_REQUESTS), samples, answered, later_s, loss, round_trip)

    def _round_trip(self, key: PathKey) -> tuple[float, bool]:
        """Return the median round trip of a path, and whether it was measured; NaN if its ends tell nothing either.

        If it was not measured: i to j takes as long as i to l, plus what k to j takes longer than k to l; in the median
        over all k and l. Without such a square, it is the median over the interface's paths, or else over the server's.
        """
        if key in self._round_trips:
            return self._round_trips[key], True
        if key not in self._guessed:
            self._guessed[key] = self._guess(*key)
        return self._guessed[key], False

    def _guess(self, interface: InterfaceName, server: NodeName) -> float:
        known = self._round_trips
        over = {j: took for (i, j), took in known.items() if i == interface}
        to = {i: took for (i, j), took in known.items() if j == server}
        squares = [over[j] + to[i] - took for (i, j), took in known.items() if j in over and i in to]
        for found in (squares, over.values(), to.values()):
            if found:
                return max(0.0, median(found))
        return math.nan

    def _size_cost(self, interface: InterfaceName, size_class: int, now: float) -> float:
        """Return how many seconds slower than probes requests of the class are: over this interface, else over any."""
        key = (interface, size_class)
        if key not in self._size_costs:
            found = self._costs(self._rows.get(key, ()), now)
            self._size_costs[key] = median(found) if found else self._size_cost_anywhere(size_class, now)
        return self._size_costs[key]

    def _size_cost_anywhere(self, size_class: int, now: float) -> float:
        if size_class not in self._size_costs_anywhere:
            of_class = [row for (_, of), row in self._rows.items() if of == size_class]
            found = [cost for row in of_class for cost in self._costs(row, now)]
            self._size_costs_anywhere[size_class] = median(found) if found else 0.0
        return self._size_costs_anywhere[size_class]

    def _costs(self, cells: Iterable[CellKey], now: float) -> list[float]:
        costs = []
        for of in cells:
            there = self._round_trips.get(of[:2])
            times = self._cells[of].distribution()
            if there is None or times is None or self._cells[of].aged(now) < SIZE_COST_REQUESTS:
                continue
            took = times.median()
            if math.isfinite(took):
                costs.append(max(0.0, took - there))
        return costs

    def _refresh(self, now: float) -> None:
        if self._fresh:
            return
        self._fresh = True
        medians = {key: path.rtt.median() for key, path in self.paths.items()}
        self._round_trips = {key: took for key, took in medians.items() if not math.isnan(took)}
        self._size_costs.clear()
        self._size_costs_anywhere.clear()
        self._guessed.clear()
        self._rows.clear()
        for of in sorted(self._cells, key=lambda of: self._cells[of].weight(now), reverse=True):
            self._rows.setdefault((of[0], of[2]), []).append(of)
