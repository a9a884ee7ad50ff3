"""Walks one request and its answer through the joined cores of a robot and a cloud, and notes each call.

Only functions of this project count: neither the standard library nor what dataclasses generate. A generator counts
each time it goes on.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple, ParamSpec, TypeVar

from bench.core_speed import ANSWER, ONE_WAY_S, SERVICE, Pair
from plr.sidecar.core.base.request_id import is_race
from plr.sidecar.core.base.values import RequestId
from plr.sidecar.core.path.congestion.choice import DEFAULT_CONTROLLER
from plr.sidecar.core.seam.application import ExecuteRequest, ResponseArrived

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from types import FrameType

    from bench.core_speed import Side
    from plr.sidecar.core.base.values import ExecutionId
    from plr.sidecar.core.link.sender import Batch
    from plr.sidecar.core.seam.application import ApplicationEvent
    from plr.sidecar.core.seam.links import LinkEvent

    P = ParamSpec("P")
    R = TypeVar("R")

ROOT = f"{Path(__file__).parents[2]}/"
PACKAGES = ("plr/sidecar/", "plr/protos/")
WARM_REQUESTS = 50
QUIET_STEPS = 30
"""Steps after the warm requests, until every acknowledgement has come."""
PAYLOAD = bytes(1000)


class Call(NamedTuple):
    """One call of a function."""

    file: str
    function: str


@dataclass(frozen=True, slots=True)
class Leg:
    """A part of the walk, from one border of a core to the next."""

    name: str
    calls: tuple[Call, ...]
    changes: int
    """Calls that lie in another file than the call before."""

    @property
    def files(self) -> set[str]:
        """Return the files whose functions were called."""
        return {call.file for call in self.calls}

    @property
    def functions(self) -> int:
        """Return the number of different functions called."""
        return len(set(self.calls))


def both_cores(legs: list[Leg]) -> Leg:
    """Return the sum of all legs."""
    return Leg("both cores", tuple(call for leg in legs for call in leg.calls), sum(leg.changes for leg in legs))


def walk_of_a_request() -> list[Leg]:
    """Carry one request and its answer; return the legs in order."""
    pair = Pair(16, DEFAULT_CONTROLLER)
    for _ in range(WARM_REQUESTS):
        pair.call(PAYLOAD, 1)
    for _ in range(QUIET_STEPS):
        pair.step()
    return list(_Walk(pair.robot, pair.cloud, pair.now).legs(_next_id(pair.sent)))


def _next_id(sent: int) -> RequestId:
    """Return the id of a request that is no full race, as seven of eight are."""
    ids = (RequestId(number.to_bytes(16, "big")) for number in range(sent + 1, sent + 1000))
    return next(one for one in ids if not is_race(one))


class _Walk:
    def __init__(self, robot: Side, cloud: Side, now: float) -> None:
        self._robot = robot
        self._cloud = cloud
        self._now = now

    def legs(self, request: RequestId) -> Iterator[Leg]:
        robot, cloud = self._robot, self._cloud
        leg, _ = _noted("robot engine: submit", self._submit, request)
        yield leg
        leg, batches = _noted("robot link: seal", self._send, robot)
        yield leg
        self._now += ONE_WAY_S
        leg, news = _noted("cloud link: open", self._receive, cloud, batches, robot.address)
        yield leg
        leg, events = _noted("cloud engine: run once", self._tell, cloud, news)
        yield leg
        execution = next(event.execution for event in events if isinstance(event, ExecuteRequest))
        leg, _ = _noted("cloud engine: complete", self._complete, execution)
        yield leg
        leg, batches = _noted("cloud link: seal", self._send, cloud)
        yield leg
        self._now += ONE_WAY_S
        leg, news = _noted("robot link: open", self._receive, robot, batches, cloud.address)
        yield leg
        leg, _ = _noted("robot engine: answer wins", self._deliver, news)
        yield leg

    def _submit(self, request: RequestId) -> None:
        self._robot.engine.robot.requests.submit(request, SERVICE, PAYLOAD, self._now)

    def _complete(self, execution: ExecutionId) -> None:
        self._cloud.engine.cloud.complete(execution, ANSWER, 0.0, self._now)

    def _send(self, side: Side) -> list[Batch]:
        for _, command in side.engine.take_commands():
            side.link.execute(command, self._now)
        batches: list[Batch] = []
        while more := side.link.batches_to_send(self._now):
            batches += more
        return batches

    def _receive(self, side: Side, batches: list[Batch], source: tuple[str, int]) -> list[LinkEvent]:
        for _, data, segment in batches:
            side.link.receive_batch(memoryview(data), segment, source, self._now)
        news: list[LinkEvent] = []
        while (event := side.link.next_event()) is not None:
            news.append(event)
        return news

    def _tell(self, side: Side, news: list[LinkEvent]) -> list[ApplicationEvent]:
        for event in news:
            side.engine.on_link_event(event, self._now)
        return side.engine.take_events()

    def _deliver(self, news: list[LinkEvent]) -> None:
        for event in self._tell(self._robot, news):
            if isinstance(event, ResponseArrived):
                self._robot.engine.robot.requests.judge_answer(event.request_id, event.copy, None, self._now)


def _noted(name: str, act: Callable[P, R], *args: P.args, **kwargs: P.kwargs) -> tuple[Leg, R]:
    """Call `act`; return the calls that it makes, as a leg, and its result."""
    calls: list[Call] = []

    def note(frame: FrameType, event: str, _arg: object) -> None:
        code = frame.f_code
        if event == "call" and code.co_filename.startswith(ROOT):
            file = code.co_filename.removeprefix(ROOT)
            if file.startswith(PACKAGES):
                calls.append(Call(file, code.co_qualname))

    before = sys.getprofile()
    sys.setprofile(note)
    try:
        result = act(*args, **kwargs)
    finally:
        sys.setprofile(before)
    return Leg(name, tuple(calls), sum(one.file != other.file for one, other in pairwise(calls))), result
