"""Keeps the picture up to date by redrawing only what may have changed.

A robot's use is redrawn at once when one of its paths goes up or down, when the offers to it change, or when the robot
misses far more deadlines than was believed. Other reports wait for the next routine solving. The uses drawn longest ago
go first, and at most `ROUTINE_PAIRS` at a time: so the work for a large fleet is bounded. A block that came out as
before, within what a change of the mapping could be worth, stays the very same object, which the matcher need not solve
again.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, NamedTuple

from plr.controlplane.core.formulation.block import BlockNotes, Picture, draw_block, interfaces_of
from plr.controlplane.core.policy.path_rules import PathRules
from plr.controlplane.core.problem.problem import BlockKey, FleetKey, Problem
from plr.protos.model.ids import Role

if TYPE_CHECKING:
    from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence

    from plr.controlplane.core.estimate.estimator import Estimator
    from plr.controlplane.core.policy.path_rules import PathRule
    from plr.controlplane.core.policy.permits import Group, Permits
    from plr.controlplane.core.problem.problem import Block, Objective
    from plr.controlplane.core.registry.registry import Sidecar
    from plr.protos.model.ids import InterfaceName, NodeName, ServiceName
    from plr.protos.model.members import InterfaceLabel, Registration, ServiceOffer, ServiceUse
    from plr.protos.model.report import Report

    _Way = tuple[tuple[InterfaceName, ...], frozenset[tuple[InterfaceName, NodeName]]]
    """Interfaces, and barred pairs of them and clouds."""

SLICE_PAIRS = 40
"""Pairs (interface, server) estimated at a time: some milliseconds, for which streams wait."""

ROBOT_PAIRS = 400
"""Pairs of one robot estimated for one picture, apart from finishing the current use; the others wait for the next
pictures. So a robot that names many interfaces and services delays no other robot. A robot with 8 interfaces that calls
4 services on 16 servers has some 500."""

USE_PAIRS = 1024
"""Pairs of one use: as many as the estimator keeps."""

MAX_CONSIDERED_INTERFACES = 64
"""Interfaces of one robot that are considered, the first that it names; fewer if there are many servers, ..."""

LEAST_INTERFACES = 16
"""... but not fewer than these."""

LOOKED_AT_ONCE = 200
"""Uses, or robots without any, checked in one go for who could serve them: some milliseconds."""

CLOUDS_A_LOOK = 8
"""Clouds, of those that could serve a use, that count as one more use: if a policy has a rule for each robot, all of
them are asked for each robot."""

FEW_ROBOTS = 16
"""Up to this many robots to be drawn at once are all re-estimated; of more, only those that have to be."""

URGENT_AT_ONCE, URGENT_SHARE = 250, 0.25
"""Urgent robots drawn for one picture: this many, or this share of those waiting, if that is more. So their mappings
leave while the next ones are drawn, and each picture, which takes time for the whole fleet, is worth it. With 64 at a
time a fleet of 500 was mapped a quarter later than all at once."""

ROUTINE_PAIRS = 4000
"""Pairs estimated between two routine solvings because of reports alone: a tenth of a processor."""

SURPRISE_MISSES = 2.0
"""Misses beyond those expected since a robot was drawn from which it does not wait for its turn."""

STALE_S = 30.0
"""Interval at which a robot that does not report is redrawn, as old measurements fade."""

EPSILON_SHARE, EPSILON_LEAST = 0.05, 1e-5
"""An epsilon closer to its old value counts as unchanged: half of what a change must win (`stability`)."""

LIFT_SHARE = 0.1
WEIGHT_SHARE = 0.25
"""The same for lifts, and for the weight of an epsilon, whose root counts."""


@dataclass(frozen=True, slots=True)
class _Inputs:
    """What a block is drawn from besides measurements; equal if nothing of that changed."""

    interfaces: tuple[InterfaceName, ...]
    """Those that are considered."""
    labels: tuple[InterfaceLabel, ...]
    use: ServiceUse
    offers: tuple[tuple[Registration, ServiceOffer], ...]
    barred: frozenset[tuple[InterfaceName, NodeName]]
    unserved: str
    robot: Sidecar = field(compare=False)
    clouds: tuple[Sidecar, ...] = field(compare=False)

    @property
    def pairs(self) -> int:
        """Pairs to estimate; if second copies leave late, each takes half as long again."""
        pairs = len(self.interfaces) * len(self.clouds)
        return pairs + pairs // 2 if self.use.redundancy.sends_late else pairs


@dataclass(slots=True)
class _Drawn:
    """A use of a robot as last drawn."""

    inputs: _Inputs
    block: Block | None
    notes: BlockNotes


@dataclass(slots=True)
class _Work:
    """A robot that is being drawn."""

    robot: NodeName
    estimate_again: bool
    urgent: bool
    uses: list[tuple[BlockKey, _Inputs]]
    """Uses still to be drawn, the last one first."""
    steps: Generator[float, None, None] | None = None
    """Steps of the use that is being drawn."""
    pairs: float = 0.0
    """Pairs estimated for this picture."""


@dataclass(frozen=True, slots=True)
class _LookedAt:
    """What a robot, as it was then, could call where."""

    robot: Sidecar
    uses: tuple[tuple[BlockKey, _Inputs], ...]

    def holds_for(self, robot: Sidecar) -> bool:
        """Return whether nothing relevant of the robot has changed; equal but not identical counts as changed."""
        was = self.robot
        return robot is was or (
            robot.services is was.services and robot.candidates is was.candidates and robot.labels is was.labels
        )


@dataclass(frozen=True, slots=True)
class _Frame:
    """Who is present, and what each robot could call where."""

    uses: Mapping[NodeName, tuple[tuple[BlockKey, _Inputs], ...]]
    fleet_capacity: Mapping[FleetKey, int]


class Drawing:
    """Keeps the picture up to date. Times are monotonic seconds."""

    def __init__(
        self, *, default_capacity_interfaces: int, objective: Objective, path_rules: Sequence[PathRule] = ()
    ) -> None:
        self._path_rules = PathRules(path_rules)
        self._capacity = default_capacity_interfaces
        self._objective = objective
        self._frame: _Frame | None = None
        self._looking: Iterator[None] | None = None
        """Makes the next frame."""
        self._around: list[object] = []
        """The policy, and what matters of the clouds, when ..."""
        self._looked_at: dict[NodeName, _LookedAt] = {}
        """... these robots were last examined."""
        self._outdated: dict[NodeName, _LookedAt] = {}
        """What holds no longer; freed robot by robot, as all of it at once takes tens of milliseconds."""
        self._drawn: dict[BlockKey, _Drawn] = {}
        self._at: dict[NodeName, float] = {}
        """When each robot was last drawn."""
        self._urgent: dict[NodeName, bool] = {}
        """Robots to draw whatever it costs, and whether their pairs have to be re-estimated."""
        self._surprise: dict[NodeName, float] = {}
        """Robots that reported since they were drawn, and their misses beyond those expected."""
        self._routine = False
        self._queue: list[NodeName] | None = None
        """Robots still to be drawn for the next picture because of reports, the last one first; None until
        determined."""
        self._urgent_order: list[NodeName] = []
        """The urgent robots, the last one first, without those that became urgent since."""
        self._urgent_most = 0
        self._urgent_drawn = 0
        """Urgent robots drawn for the next picture, of at most `_urgent_most`."""
        self._routine_pairs = 0
        self._work: _Work | None = None
        """The robot that is being drawn."""
        self._aside: dict[NodeName, _Work] = {}
        """Robots that have had their share of this picture."""
        self._rests: dict[NodeName, list[tuple[BlockKey, _Inputs]]] = {}
        """Remaining uses of robots that wait for another picture with some of them, ..."""
        self._first: dict[NodeName, BlockKey] = {}
        """... or, for a robot to be drawn whole again, the use to begin with: all of them get their turn."""

    # ── what changed ──

    def members_changed(self) -> None:
        """Note that a sidecar, its addresses or services, or the policy changed."""
        self._frame = self._looking = None

    def robot_changed(self, robot: NodeName, *, estimate_again: bool = True) -> None:
        """Draw this robot in the next picture whatever it costs.

        Unless `estimate_again`, existing pairs may keep their estimates: its paths changed, not what is known of them.
        They do when many robots changed at once, as when a server dies: all need other mappings within a second, and
        are re-estimated in their turn.
        """
        self._urgent[robot] = estimate_again or self._urgent.get(robot, False)
        self._draw_whole(robot)

    def is_urgent(self, robot: NodeName) -> bool:
        """Return whether it is to be drawn whatever it costs."""
        return robot in self._urgent

    def blocks(self, robot: NodeName, services: Iterable[ServiceName]) -> Iterator[Block]:
        """Yield the blocks of a robot's uses of these services as last drawn, as far as there are any."""
        for service in services:
            drawn = self._drawn.get(BlockKey(robot, service))
            if drawn is not None and drawn.block is not None:
                yield drawn.block

    def cost(self, robot: NodeName) -> int:
        """Return how many pairs it takes to draw a robot."""
        uses = self._frame.uses.get(robot, ()) if self._frame is not None else ()
        return sum(inputs.pairs for _, inputs in uses)

    def _draw_whole(self, robot: NodeName) -> None:
        """Note that more of a robot is to be drawn than what was left."""
        rest = self._rests.pop(robot, None)
        if rest:
            self._first[robot] = rest[-1][0]

    def reported(self, robot: NodeName, report: Report) -> bool:
        """Note that a robot's report was merged; return True if it misses far more deadlines than was believed."""
        surprise = self._surprise.get(robot, 0.0)
        for latency in report.latencies:
            if not latency.missed:
                continue
            drawn = self._drawn.get(BlockKey(robot, latency.service))
            believed = _epsilon(drawn.block, latency.interface, latency.server) if drawn and drawn.block else 0.0
            surprise += max(0.0, latency.missed - latency.requests * believed)
        self._surprise[robot] = surprise
        return surprise >= SURPRISE_MISSES

    # ── drawing ──

    def begin(self, *, routine: bool) -> None:
        """Begin the next picture; unless `routine`, new reports alone do not matter for it."""
        self._routine = routine
        self._queue = None
        self._put_back()
        for robot, work in self._aside.items():
            if work.urgent and robot not in self._urgent and (robot in self._rests or robot in self._first):
                self._urgent[robot] = work.estimate_again
        self._aside.clear()
        self._urgent_order.clear()
        self._urgent_drawn = self._routine_pairs = 0

    @property
    def urgent_left(self) -> bool:
        """Whether the next picture is wanted at once, for robots that this one has no room for."""
        return bool(self._urgent) or any(work.urgent for work in self._aside.values())

    @property
    def routine_left(self) -> bool:
        """Whether some robots due because of reports were left out."""
        return bool(self._queue) or any(not work.urgent for work in self._aside.values())

    def advance(
        self,
        sidecars: Iterable[Sidecar],
        permits: Permits,
        estimator: Estimator,
        now: float,
        lost: Callable[[NodeName], float] = lambda robot: 0.0,
    ) -> bool:
        """Draw some of what has to be drawn for the next picture; return True once that is complete.

        `sidecars` are those ready. Urgent robots go first, those with most `lost` before others; beside them those that
        merely reported get a slice. Call this again until it returns True, with other work in between.
        """
        if self._frame is None:
            if self._looking is None:
                self._put_back()
                for robot in list(self._rests):
                    self._draw_whole(robot)
                self._looking = self._look_around(sidecars, permits)
            for _ in self._looking:
                return False
            self._looking = None
        assert self._frame is not None
        if self._queue is None:
            self._queue = self._next_routine(self._frame, now) if self._routine else []
        pairs = 0.0
        while pairs < SLICE_PAIRS:
            if self._work is None:
                self._work = self._next_work(self._frame, lost, now)
                if self._work is None:
                    return True
            work = self._work
            took = self._draw_some(work, estimator, now)
            pairs += took
            work.pairs += took
            if work.steps is None and not work.uses:
                self._work = None
            elif work.steps is None and work.pairs >= ROBOT_PAIRS:
                self._set_aside(work)
        return not (self._work or self._urgent or self._queue)

    def _draw_some(self, work: _Work, estimator: Estimator, now: float) -> float:
        """Draw some of it; return the number of pairs estimated, or of pairs that would have taken that long."""
        if work.steps is None:
            if not work.uses:
                return 0.0
            work.steps = self._draw_use(*work.uses.pop(), estimator, now, estimate_again=work.estimate_again)
        try:
            return next(work.steps)
        except StopIteration:
            work.steps = None
            return 0.0

    def _set_aside(self, work: _Work) -> None:
        """Set aside a robot that has had its share of this picture."""
        self._work = None
        self._aside[work.robot] = work
        if work.robot not in self._urgent:
            self._rests[work.robot] = work.uses
        else:
            self._first[work.robot] = work.uses[-1][0]
        if not work.urgent:
            self._surprise.setdefault(work.robot, 0.0)

    def _next_work(self, frame: _Frame, lost: Callable[[NodeName], float], now: float) -> _Work | None:
        found = self._next_robot(lost)
        if found is None:
            return None
        robot, estimate_again, urgent = found
        uses = list(frame.uses.get(robot, ()))
        rest = self._rests.pop(robot, None)
        if rest is not None:
            uses = rest[::-1]
        elif (first := self._first.pop(robot, None)) is not None:
            begin = next((number for number, (key, _) in enumerate(uses) if key == first), 0)
            uses = uses[begin:] + uses[:begin]
        if estimate_again or robot not in self._at:
            self._at[robot] = now
            self._surprise.pop(robot, None)
        return _Work(robot, estimate_again, urgent, uses[::-1])

    def _next_robot(self, lost: Callable[[NodeName], float]) -> tuple[NodeName, bool, bool] | None:
        """Return the robot to draw next, whether to re-estimate it, and whether it is urgent; None if the picture is
        complete."""
        if not self._urgent_drawn:
            self._urgent_most = max(URGENT_AT_ONCE, round(URGENT_SHARE * len(self._urgent)))
        urgent = self._next_urgent(lost) if self._urgent_drawn < self._urgent_most else None
        if urgent is not None:
            few = len(self._urgent) + self._urgent_drawn <= FEW_ROBOTS
            self._urgent_drawn += 1
            return urgent, self._urgent.pop(urgent) or few, True
        if self._queue and (not self._urgent_drawn or self._routine_pairs < SLICE_PAIRS):
            robot = self._queue.pop()
            self._routine_pairs += min(ROBOT_PAIRS, self.cost(robot))
            return robot, True, False
        return None

    def _next_urgent(self, lost: Callable[[NodeName], float]) -> NodeName | None:
        """Return the next urgent robot of those that have not had their share of this picture."""
        for again in (False, True):
            if again:
                waiting = [robot for robot in reversed(self._urgent) if robot not in self._aside]
                self._urgent_order = sorted(waiting, key=lost)
            while self._urgent_order:
                robot = self._urgent_order.pop()
                if robot in self._urgent and robot not in self._aside:
                    return robot
        return None

    def _put_back(self) -> None:
        """Redraw a partly drawn robot, beginning with the use that was being drawn."""
        if self._work is not None:
            work, self._work = self._work, None
            self.robot_changed(work.robot, estimate_again=work.estimate_again)

    def picture(self) -> Picture:
        """Return what was drawn."""
        frame = self._frame or _Frame({}, {})
        keys = [key for uses in frame.uses.values() for key, _ in uses if key in self._drawn]
        blocks = tuple(block for key in keys if (block := self._drawn[key].block) is not None)
        notes = {key: self._drawn[key].notes for key in keys}
        return Picture(Problem(blocks, frame.fleet_capacity, self._objective), notes)

    def _look_around(self, sidecars: Iterable[Sidecar], permits: Permits) -> Iterator[None]:
        """Find out in several goes who could call what where; the end result is the frame.

        For unchanged robots, while clouds and policy are unchanged, earlier results hold. So an interruption by the
        next change does not lose the progress.
        """
        clouds: dict[tuple[ServiceName, str], list[_Offered]] = {}
        fleet_capacity: dict[FleetKey, int] = {}
        robots: list[Sidecar] = []
        around: list[object] = [permits]
        looked_at = 0
        for sidecar in sorted(sidecars, key=lambda sidecar: sidecar.registration.name):
            if sidecar.role is Role.ROBOT:
                robots.append(sidecar)
                continue
            if sidecar.draining:
                continue
            around.append((sidecar.registration, sidecar.services, sidecar.offered))
            offers = sidecar.offers
            for offer in offers:
                clouds.setdefault((offer.name, offer.type), []).append(_Offered(sidecar, offer))
                if offer.capacity:
                    fleet_capacity[FleetKey(sidecar.name, offer.name)] = offer.capacity
            looked_at += len(offers) // CLOUDS_A_LOOK
            if looked_at >= LOOKED_AT_ONCE:
                looked_at = 0
                yield
        if around != self._around:
            self._around = around
            self._outdated |= self._looked_at
            self._looked_at = {}
        callable_by: dict[tuple[Group, ServiceName, str], tuple[_Offered, ...]] = {}
        uses: dict[NodeName, tuple[tuple[BlockKey, _Inputs], ...]] = {}
        for robot in robots:
            self._outdated.pop(robot.name, None)
            known = self._looked_at.get(robot.name)
            if known is not None and known.holds_for(robot):
                uses[robot.name] = known.uses
                continue
            group = permits.group(robot.name)
            ways = _Ways(robot, self._path_rules)
            found = []
            for use in robot.uses:
                kind = group, use.name, use.type
                offered = clouds.get((use.name, use.type), [])
                if kind not in callable_by:
                    may_call: list[_Offered] = []
                    for begin in range(0, len(offered), CLOUDS_A_LOOK):
                        some = offered[begin : begin + CLOUDS_A_LOOK]
                        may_call += (one for one in some if use.name in permits.of(group, one.cloud))
                        looked_at += len(some) // CLOUDS_A_LOOK
                        if looked_at >= LOOKED_AT_ONCE:
                            looked_at = 0
                            yield
                    callable_by[kind] = tuple(may_call)
                found.append((BlockKey(robot.name, use.name), _inputs(ways, use, offered, callable_by[kind])))
                looked_at += 1 + len(callable_by[kind]) // CLOUDS_A_LOOK
                if looked_at >= LOOKED_AT_ONCE:
                    looked_at = 0
                    yield
            uses[robot.name] = tuple(found)
            self._looked_at[robot.name] = _LookedAt(robot, uses[robot.name])
            if any(key not in self._drawn or self._drawn[key].inputs != inputs for key, inputs in found):
                self.robot_changed(robot.name, estimate_again=False)
            if not found:
                looked_at += 1
                if looked_at >= LOOKED_AT_ONCE:
                    looked_at = 0
                    yield
        self._forget_others(uses)
        self._frame = _Frame(uses, fleet_capacity)

    def _forget_others(self, uses: Mapping[NodeName, tuple[tuple[BlockKey, _Inputs], ...]]) -> None:
        keys = {key for wanted in uses.values() for key, _ in wanted}
        for drawn in [key for key in self._drawn if key not in keys]:
            del self._drawn[drawn]
        tables: tuple[dict[NodeName, Any], ...]
        tables = self._at, self._surprise, self._looked_at, self._outdated, self._aside, self._rests, self._first
        for table in tables:
            for gone in [name for name in table if name not in uses]:
                del table[gone]

    def _next_routine(self, frame: _Frame, now: float) -> list[NodeName]:
        """Return robots to draw because of reports, those to be drawn first last."""
        routine = [name for name in frame.uses if name not in self._urgent and self._is_due(name, now)]
        routine.sort(key=lambda name: self._at.get(name, 0.0))
        pairs, taken = 0, 0
        for name in routine:
            pairs += min(ROBOT_PAIRS, sum(inputs.pairs for _, inputs in frame.uses[name]))
            taken += 1
            if pairs >= ROUTINE_PAIRS:
                break
        return routine[:taken][::-1]

    def _is_due(self, robot: NodeName, now: float) -> bool:
        return robot in self._surprise or now - self._at.get(robot, now) >= STALE_S

    def _draw_use(
        self, key: BlockKey, inputs: _Inputs, estimator: Estimator, now: float, *, estimate_again: bool
    ) -> Generator[float, None, None]:
        """Draw a use; yields like `draw_block`."""
        before = self._drawn.get(key)
        if inputs.unserved:
            servers = tuple(cloud.name for cloud in inputs.clouds)
            self._drawn[key] = _Drawn(inputs, None, BlockNotes(servers, unserved=inputs.unserved))
            return
        kept = before is not None and not estimate_again and before.inputs.use == inputs.use
        known = (before.block, before.notes) if before is not None and before.block is not None and kept else None
        block, notes = yield from draw_block(
            inputs.robot,
            inputs.use,
            inputs.interfaces,
            inputs.clouds,
            estimator,
            now,
            capacity=self._capacity,
            barred=inputs.barred,
            known=known,
            before=before.block if before is not None else None,
        )
        if before is not None and before.block is not None and is_alike(block, before.block):
            block = before.block
        self._drawn[key] = _Drawn(inputs, block, notes)


class _Offered(NamedTuple):
    """A service that a cloud offers."""

    cloud: Sidecar
    offer: ServiceOffer


class _Ways:
    """Which interfaces of a robot lead where; its uses share this."""

    def __init__(self, robot: Sidecar, path_rules: PathRules) -> None:
        self.robot = robot
        self._interfaces = interfaces_of(robot)
        self._path_rules = path_rules
        self._about = path_rules.about(robot.name)
        self._to: dict[tuple[NodeName, ...], _Way] = {}
        """By the names of clouds."""

    def to(self, clouds: Sequence[Sidecar]) -> _Way:
        """Return the interfaces considered for these clouds, and which pairs the path rules bar."""
        names = tuple(cloud.name for cloud in clouds)
        way = self._to.get(names)
        if way is None:
            most = max(LEAST_INTERFACES, min(MAX_CONSIDERED_INTERFACES, USE_PAIRS // max(1, len(names))))
            interfaces = self._interfaces[:most]
            way = self._to[names] = interfaces, self._path_rules.barred(self._about, interfaces, names)
        return way


def _inputs(ways: _Ways, use: ServiceUse, offering: Sequence[_Offered], may_call: Sequence[_Offered]) -> _Inputs:
    """Return the inputs of a use: of those `offering` the service, `may_call` are those that the robot may call."""
    robot = ways.robot
    clouds = tuple(one.cloud for one in may_call)
    interfaces, barred = ways.to(clouds)
    if not offering:
        unserved = f"no live server offers it as {use.type}"
    elif not clouds:
        unserved = "the access policy lets this robot call it on no live server"
    elif not interfaces:
        unserved = "the robot has announced no address yet"
    elif len(barred) == len(interfaces) * len(clouds):
        unserved = "the path rules let this robot use no path to a live server"
    else:
        unserved = ""
    offers = tuple((one.cloud.registration, one.offer) for one in may_call)
    return _Inputs(interfaces, robot.labels, use, offers, barred, unserved, robot, clouds)


def _epsilon(block: Block, interface: InterfaceName, server: NodeName) -> float:
    if interface not in block.interfaces or server not in block.servers:
        return 0.0
    return block.epsilon[block.interfaces.index(interface)][block.servers.index(server)] or 0.0


def is_alike(block: Block, before: Block) -> bool:
    """Return whether a block differs from its old state by no more than no change of the mapping could be worth."""
    if replace(block, epsilon=before.epsilon, lifts=before.lifts, weights=before.weights) != before:
        return False
    if len(block.weights) != len(before.weights) or block.lifts.keys() != before.lifts.keys():
        return False
    return (
        _are_near(_flat(block.epsilon), _flat(before.epsilon), EPSILON_SHARE)
        and _are_near(_flat(block.weights), _flat(before.weights), WEIGHT_SHARE)
        and all(abs(lift - before.lifts[pair]) <= LIFT_SHARE * before.lifts[pair] for pair, lift in block.lifts.items())
    )


def _flat(rows: Iterable[Iterable[float | None]]) -> Iterator[float | None]:
    for row in rows:
        yield from row


def _are_near(values: Iterable[float | None], before: Iterable[float | None], share: float) -> bool:
    for value, then in zip(values, before, strict=True):
        if value is None or then is None:
            if value is not then:
                return False
        elif abs(value - then) > max(EPSILON_LEAST, share * then):
            return False
    return True
