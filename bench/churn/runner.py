"""Plays a schedule against the running system, and notes when each resource was back in use."""

from __future__ import annotations

import re
import time
from collections import deque
from dataclasses import dataclass
from typing import TYPE_CHECKING

from bench.churn.machine import Machine
from bench.churn.samples import Watch
from bench.churn.schedule import CALM_END_S, PATHS, SERVERS, SPARED_FROM, Lane, Trouble, ends_a_judged_process, others

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from bench.churn.hands import Hands
    from lab.system import Part

TURN_S = 0.05
LOOK_EVERY_S = 0.5
"""Interval between checks whether something is back; each costs the machine a scrape."""
SAMPLE_EVERY_S = 5.0
STUCK_S = 60.0
"""A resource not back in use this long after its trouble is a failure of its own."""
_PROGRESS = re.compile(r"sent\s+(\d+)\s+unanswered\s+(\d+)")


@dataclass(slots=True)
class Done:
    """A trouble as it really happened, in seconds of the run; None means not within the run."""

    trouble: Trouble
    began_s: float
    ended_s: float | None = None
    back_s: float | None = None


@dataclass(slots=True)
class _LaneState:
    """One lane at work: at most one trouble in force, at most one resource per target coming back."""

    queue: deque[Trouble]
    shift_s: float = 0.0
    """How much later than planned its troubles come, because a recovery took longer."""
    current: Done | None = None


class Runner:
    """One run."""

    def __init__(self, hands: Hands, schedule: Iterable[Trouble], length_s: float, say: Callable[[str], None]) -> None:
        self.done: list[Done] = []
        self.failures: list[str] = []
        self.watch = Watch()
        self.machine = Machine()
        self._hands = hands
        self._length_s = length_s
        self._say = say
        planned = list(schedule)
        self._lanes = {lane: _LaneState(deque(t for t in planned if t.lane is lane)) for lane in Lane}
        self._returning: dict[str, Done] = {}
        """Troubles whose target is not back in use yet, by target."""
        self._well = set(PATHS) | set(SERVERS)
        self._zero = 0.0
        self._load = ""

    @property
    def postponed_s(self) -> dict[str, float]:
        """How much later than planned the last troubles of each lane came."""
        return {lane.value: state.shift_s for lane, state in self._lanes.items()}

    def run(self, clients: list[Part], ours: list[str], show: Callable[[str], None]) -> None:
        """Play the schedule to its end; `ours` names the parts to watch, `show` takes a line of progress."""
        self._zero = time.monotonic()
        look_at = sample_at = 0.0
        while (now := self._now()) < self._length_s:
            for lane in Lane:
                self._turn(lane, now)
            if now >= look_at:
                look_at = now + LOOK_EVERY_S
                self._look()
                show(self._progress(now, clients))
            if now >= sample_at:
                sample_at = now + SAMPLE_EVERY_S
                parts = self._hands.system.parts
                self.watch.take(now, {name: parts[name] for name in ours})
                self._load = str(self.machine.look(now))
            time.sleep(TURN_S)
        for state in self._lanes.values():
            if state.current is not None:
                self._end(state, self._now())

    def _now(self) -> float:
        return time.monotonic() - self._zero

    def _turn(self, lane: Lane, now: float) -> None:
        state = self._lanes[lane]
        if state.current is not None:
            if now >= state.current.began_s + state.current.trouble.lasts_s:
                self._end(state, now)
            return
        if not state.queue:
            return
        trouble = state.queue[0]
        if now < trouble.begins_s + state.shift_s:
            return
        if any(other not in self._well for other in others(trouble)):
            state.shift_s = now - trouble.begins_s
            return
        state.queue.popleft()
        if now >= self._length_s * SPARED_FROM and ends_a_judged_process(trouble):
            return  # postponed into the period in which its target is spared
        if now + trouble.lasts_s > self._length_s - CALM_END_S:
            state.queue.clear()  # postponed beyond the end
            return
        self._begin(state, trouble, now)

    def _begin(self, state: _LaneState, trouble: Trouble, now: float) -> None:
        self._well.discard(trouble.target)
        self._returning.pop(trouble.target, None)
        self._say(f"{now:6.1f} s  {trouble}")
        state.current = Done(trouble, now)
        self.done.append(state.current)
        self._hands.begin(trouble)
        if not trouble.lasts_s:
            self._end(state, now)

    def _end(self, state: _LaneState, now: float) -> None:
        done, state.current = state.current, None
        assert done is not None
        self._hands.end(done.trouble)
        done.ended_s = now
        self._returning[done.trouble.target] = done

    def _look(self) -> None:
        for target, done in list(self._returning.items()):
            if done.back_s is None and self._hands.works(done.trouble.lane, target, frozenset(self._well)):
                done.back_s = self._now()
                assert done.ended_s is not None
                self._say(f"{done.back_s:6.1f} s  {target} in use again after {done.back_s - done.ended_s:.1f} s")
                del self._returning[target]
                self._well.add(target)
            elif done.ended_s is not None and self._now() - done.ended_s > STUCK_S:
                self.failures.append(f"{target} was not in use again {STUCK_S:g} s after: {done.trouble}")
                del self._returning[target]  # reported once; its lane goes on without waiting for it

    def _progress(self, now: float, clients: list[Part]) -> str:
        counts = []
        for client in clients:
            found = _PROGRESS.findall(client.tail(3))
            sent, unanswered = found[-1] if found else ("0", "0")
            counts.append(f"{client.name}: {sent} sent, {unanswered} open")
        return f"{self._length_s - now:5.0f} s left   {'   '.join((*counts, self._load))}"
