"""The policy of the control stream's dialer in simulated time: two carriers that go dark in turn, never both at once.

The driver here does what `plr.sidecar.net.control_dialer` does with sockets. A connection takes a round trip to
make, two more to register; what is sent over a dark carrier is neither acknowledged nor refused.
"""

from __future__ import annotations

import math
import random
from collections import Counter, deque
from dataclasses import dataclass, field
from itertools import pairwise

import pytest

from plr.protos.model.ids import Address, InterfaceName
from plr.sidecar.core.base.values import PathState
from plr.sidecar.core.control.race import ControlRace
from plr.sidecar.core.control.watch import CHEAPER, KEEPALIVE_S, SILENT, ControlWatch, Seen
from plr.sidecar.core.control.ways import WELL_S, ControlInterface, ControlWays, Price, Way

STEP_S = 0.02
WLAN, WWAN = InterfaceName("wlan0"), InterfaceName("wwan0")
CONTROL: Address = ("192.0.2.1", 50051)
ROUND_TRIPS_TO_REGISTER = 3.0
RETRY_S = 0.2
"""Largest delay before another stream, where one ended by itself."""
UNSTABLE_AFTER_S, DOWN_AFTER_S = 0.2, 0.7
"""The data plane's paths, once probed: silent for so long."""


@dataclass
class Carrier:
    """One interface: when it is dark, and what the data plane makes of it."""

    name: InterfaceName
    rtt_s: float
    probe_every_s: float
    dark: list[tuple[float, float]] = field(default_factory=list)
    probed_at: float = -math.inf
    unanswered_since: float | None = None
    heard: bool = False
    replies: deque[float] = field(default_factory=deque)
    state: PathState | None = None

    def lit(self, now: float) -> bool:
        if self.dark and now >= self.dark[0][1]:
            self.dark.pop(0)
        return not self.dark or now < self.dark[0][0]

    def probe(self, now: float) -> None:
        self.probed_at = now
        if self.lit(now):
            self.replies.append(now + self.rtt_s)
        elif self.unanswered_since is None:
            self.unanswered_since = now

    def turn(self, now: float) -> None:
        if now >= self.probed_at + (self.probe_every_s if self.unanswered_since is None else 0.05):
            self.probe(now)
        while self.replies and self.replies[0] <= now:
            self.replies.popleft()
            if self.lit(now):
                self.unanswered_since = None
                self.heard = True
        silent_s = 0.0 if self.unanswered_since is None else now - self.unanswered_since
        if self.heard:
            self.state = (
                PathState.DOWN
                if silent_s > DOWN_AFTER_S
                else PathState.UNSTABLE
                if silent_s > UNSTABLE_AFTER_S
                else PathState.UP
            )


class Robot:
    """The control stream of one robot, from 0 on."""

    def __init__(self, rng: random.Random, carriers: list[Carrier], *, say_every_s: float, billed: bool) -> None:
        self.rng = rng
        self.carriers = {carrier.name: carrier for carrier in carriers}
        self.say_every_s = say_every_s
        self.ways = ControlWays(Counter())
        self.ways.set_interfaces(
            [
                ControlInterface(name, frozenset({f"10.{number}.0.2"}), Price(billed=billed and name == WWAN))
                for number, name in enumerate(self.carriers)
            ],
            0.0,
        )
        self.ways.set_addresses([CONTROL])
        self.now = 0.0
        self.connected: list[tuple[float, float, InterfaceName]] = []
        """From, to, over what: of every registration."""
        self.left: Counter[str] = Counter()
        self._best: dict[InterfaceName, PathState] = {}
        self._end()

    def _end(self, retry_s: float = 0.0) -> None:
        self.race: ControlRace | None = None
        self.retry_at = self.now + retry_s
        self.arrivals: list[tuple[float, Way]] = []
        self.way: Way | None = None
        self.watch: ControlWatch | None = None

    def run(self, until: float) -> None:
        while self.now < until:
            self._data_plane()
            if self.watch is not None:
                self._watch()
            elif self.now >= self.retry_at:
                self._dial()
            self.now += STEP_S

    def _data_plane(self) -> None:
        for carrier in self.carriers.values():
            carrier.turn(self.now)
        self.news = False
        best = {name: carrier.state for name, carrier in self.carriers.items() if carrier.state is not None}
        if best != self._best:
            self._best = best
            self.ways.set_paths(best, self.now)
            self.news = True

    def _dial(self) -> None:
        if self.race is None:
            self.race = ControlRace(self.ways.classes(self.now), self.now)
        for way in self.race.due(self.now):
            # The routing table leads through wlan0.
            carrier = self.carriers[way.interface or WLAN]
            if carrier.lit(self.now):
                self.arrivals.append((self.now + carrier.rtt_s, way))
        for at, way in sorted(self.arrivals):
            if at <= self.now and self.carriers[way.interface or WLAN].lit(self.now):
                self._connect(way)
                return

    def _connect(self, way: Way) -> None:
        over = way.interface or WLAN
        self.way, self.over = way, self.carriers[over]
        self.watch = ControlWatch(self.ways, way, over, self.now)
        self.registered_at = self.now + (ROUND_TRIPS_TO_REGISTER - 1.0) * self.over.rtt_s
        self.heard_at = self.say_at = self.now
        self.asked_at: float | None = None
        self.look_at = self.now
        self.registered = False

    def _watch(self) -> None:
        assert self.watch is not None
        assert self.way is not None
        lit = self.over.lit(self.now)
        if lit and self.asked_at is not None and self.now >= self.asked_at + self.over.rtt_s:
            self.heard_at, self.asked_at = self.now, None
        if lit and self.now >= self.registered_at:
            if not self.registered:
                self.registered = True
                self.ways.proven(self.way)
                self.connected.append((self.now, self.now, self.over.name))
            begin, _, name = self.connected[-1]
            self.connected[-1] = (begin, self.now, name)
        speaks = self.now >= self.say_at
        if speaks:
            self.say_at = self.now + self.say_every_s
            self.watch.sent(self.now)
        if self.asked_at is None and (speaks or self.now >= self.heard_at + KEEPALIVE_S):
            self.asked_at = self.now
        if speaks or self.now >= self.look_at or self.news:
            self._judge()

    def _judge(self) -> None:
        assert self.watch is not None
        assert self.way is not None
        self.watch.saw(Seen(self.asked_at is not None, self.now - self.heard_at, self.over.rtt_s), self.now)
        doubted = self.watch.take_doubt(self.now)
        if doubted is not None:
            self.carriers[doubted].probe(self.now)
        leave = self.watch.judge(self.now)
        self.look_at = self.watch.next_timer(self.now) or self.now + 1.0
        if leave is None:
            return
        self.left[leave.cause] += 1
        if leave.cause == SILENT:
            self.ways.fell_silent(self.way, self.over.name, self.now)
        self._end(0.0 if leave.cause != CHEAPER else self.rng.uniform(0.0, RETRY_S))

    def longest_without(self) -> float:
        """Seconds from the last moment at which a stream worked to the first at which the next one did."""
        return max((later[0] - earlier[1] for earlier, later in pairwise(self.connected)), default=0.0)


def darkness(rng: random.Random, until: float) -> tuple[list[tuple[float, float]], list[tuple[float, float]]]:
    """When each of two carriers is dark: for 1 to 30 s, 1.5 to 60 s apart, never both."""
    dark: tuple[list[tuple[float, float]], list[tuple[float, float]]] = ([], [])
    at = rng.uniform(5.0, 20.0)
    while at < until:
        end = at + rng.uniform(1.0, 30.0)
        dark[rng.randrange(2)].append((at, end))
        at = end + rng.uniform(1.5, rng.choice((3.0, 60.0)))
    return dark


@pytest.mark.audit("dp-12")
@pytest.mark.parametrize("idle", [False, True], ids=["with requests", "idle"])
@pytest.mark.parametrize("billed", [False, True], ids=["one price", "wwan0 billed"])
@pytest.mark.parametrize("seed", range(3))
def test_never_more_than_two_seconds_without_a_control_plane(seed: int, idle: bool, billed: bool) -> None:
    rng = random.Random(seed)
    dark = darkness(rng, 400.0)
    probe_every_s, say_every_s = (10.0, 5.0 / 3.0) if idle else (0.1, 0.5)
    carriers = [
        Carrier(WLAN, rng.uniform(0.005, 0.05), probe_every_s, dark[0]),
        Carrier(WWAN, rng.uniform(0.03, 0.12), probe_every_s, dark[1]),
    ]
    robot = Robot(rng, carriers, say_every_s=say_every_s, billed=billed)
    robot.run(400.0)
    assert robot.left[SILENT] > 0
    assert robot.longest_without() <= 2.0


@pytest.mark.audit("dp-12")
@pytest.mark.parametrize("name", [WLAN, WWAN])
@pytest.mark.parametrize("billed", [False, True], ids=["one price", "wwan0 billed"])
def test_a_start_while_one_carrier_is_dark(name: InterfaceName, billed: bool) -> None:
    carriers = [Carrier(WLAN, 0.02, 0.5), Carrier(WWAN, 0.08, 0.5)]
    for carrier in carriers:
        carrier.dark = [(0.0, 60.0)] if carrier.name == name else []
    robot = Robot(random.Random(1), carriers, say_every_s=0.5, billed=billed)
    robot.run(10.0)
    assert robot.connected[0][0] < 1.5
    assert robot.connected[0][2] != name
    assert len(robot.connected) == 1


def test_it_goes_back_to_the_cheaper_carrier_once() -> None:
    carriers = [Carrier(WLAN, 0.02, 0.5, [(10.0, 20.0)]), Carrier(WWAN, 0.08, 0.5)]
    robot = Robot(random.Random(1), carriers, say_every_s=0.5, billed=True)
    robot.run(120.0)
    assert [name for _, _, name in robot.connected] == [WLAN, WWAN, WLAN]
    assert robot.left == {SILENT: 1, CHEAPER: 1}
    begin, end, _ = robot.connected[1]
    assert end - begin >= WELL_S


def test_a_carrier_without_udp_keeps_the_stream() -> None:
    """The data plane has heard nobody over it for long, TCP goes on."""
    carriers = [Carrier(WLAN, 0.02, 0.5), Carrier(WWAN, 0.08, 0.5)]
    robot = Robot(random.Random(1), carriers, say_every_s=0.5, billed=True)
    robot.run(10.0)
    carriers[0].turn = lambda now: setattr(carriers[0], "state", PathState.DOWN)  # type: ignore[method-assign]
    robot.run(60.0)
    assert robot.left == {}
    assert [name for _, _, name in robot.connected] == [WLAN]
