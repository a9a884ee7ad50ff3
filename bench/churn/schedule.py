"""Draws which trouble befalls what and when, as a pure function of seed and length.

There are three independent lanes: the robot's paths, the servers, the control plane. Within a lane at most one resource
is in trouble, and a rest follows each trouble, so that at least one path and one server are always well. A rest does
not prove that the resource is back: the runner waits until it is seen to be, and shifts the rest of the lane by that
wait.

In the last two thirds of a run the sidecar of the first server and the control plane are spared. By the second half
they have warmed up, so that the growth of their memory can be judged. The troubles of everything around them go on.
"""

from __future__ import annotations

import random
from dataclasses import dataclass
from enum import StrEnum

PATHS = ("wlan0", "wwan0")
SERVERS = ("cloud_a", "cloud_b")
CONTROL = "control plane"


class Lane(StrEnum):
    """Resources that fail one at a time."""

    PATHS = "paths"
    SERVERS = "servers"
    CONTROL = "control"


class Kind(StrEnum):
    """A kind of trouble; its value is its name in the timeline."""

    BLACKHOLE = "swallows everything, carrier stays"
    UNPLUG = "loses its carrier"
    SWITCH_OFF = "is switched off"
    LOSS_BURST = "loses 40 % of all packets"
    REBIND_NAT = "gets new ports from its NAT"
    READDRESS = "gets another address"
    KILL_ROS = "ROS server killed -9"
    KILL_SIDECAR = "sidecar killed -9"
    KILL_HOST = "ROS server and sidecar killed -9"
    STOP_SIDECAR = "sidecar stopped by SIGTERM"
    KILL_CONTROL = "killed -9"


@dataclass(frozen=True, slots=True)
class _LanePlan:
    kinds: tuple[Kind, ...]
    targets: tuple[str, ...]
    lasts_s: tuple[float, float]
    rest_s: tuple[float, float]


_MOMENTARY = frozenset({Kind.REBIND_NAT, Kind.READDRESS})
"""Troubles that are over at once: nothing has to be undone."""
_ENDS_A_SIDECAR = frozenset({Kind.KILL_SIDECAR, Kind.KILL_HOST, Kind.STOP_SIDECAR})
_PLANS = {
    Lane.PATHS: _LanePlan(
        (Kind.BLACKHOLE, Kind.UNPLUG, Kind.SWITCH_OFF, Kind.LOSS_BURST, Kind.REBIND_NAT, Kind.READDRESS),
        PATHS,
        lasts_s=(0.3, 8.0),
        rest_s=(2.0, 5.0),
    ),
    Lane.SERVERS: _LanePlan(
        (Kind.KILL_ROS, Kind.KILL_SIDECAR, Kind.KILL_HOST, Kind.STOP_SIDECAR),
        SERVERS,
        lasts_s=(1.0, 10.0),
        rest_s=(6.0, 12.0),
    ),
    Lane.CONTROL: _LanePlan((Kind.KILL_CONTROL,), (CONTROL,), lasts_s=(1.0, 25.0), rest_s=(15.0, 30.0)),
}
SPARED_FROM = 1 / 3
"""From this share of the run on, the processes judged in its second half are spared."""
FIRST_S = 3.0
"""Calm at the start ..."""
CALM_END_S = 8.0
"""... and at the end, so that the last requests are not judged by a trouble that is cut short."""


@dataclass(frozen=True, slots=True)
class Trouble:
    """One trouble; times in seconds from the start of the run."""

    lane: Lane
    kind: Kind
    target: str
    begins_s: float
    lasts_s: float

    @property
    def ends_s(self) -> float:
        """When the trouble is undone."""
        return self.begins_s + self.lasts_s

    def __str__(self) -> str:
        lasting = f" for {self.lasts_s:.1f} s" if self.lasts_s else ""
        return f"{self.target} {self.kind.value}{lasting}"


def make_schedule(seed: int, length_s: float) -> tuple[Trouble, ...]:
    """Draw the troubles of a run of `length_s`, in the order in which they begin."""
    troubles = [trouble for lane in Lane for trouble in _draw_lane(lane, random.Random(f"{seed}/{lane}"), length_s)]
    return tuple(sorted(troubles, key=lambda trouble: (trouble.begins_s, trouble.lane)))


def others(trouble: Trouble) -> tuple[str, ...]:
    """Return the resources of its lane that must work while it lasts."""
    return tuple(target for target in _PLANS[trouble.lane].targets if target != trouble.target)


def ends_a_judged_process(trouble: Trouble) -> bool:
    """Return whether it ends a process whose memory is judged over the second half; not done from SPARED_FROM on."""
    return trouble.lane is Lane.CONTROL or (trouble.kind in _ENDS_A_SIDECAR and trouble.target == SERVERS[0])


def _draw_lane(lane: Lane, rng: random.Random, length_s: float) -> list[Trouble]:
    plan = _PLANS[lane]
    troubles: list[Trouble] = []
    bag: list[tuple[Kind, str]] = []
    at = FIRST_S + rng.uniform(0.0, plan.rest_s[0])
    while True:
        if not bag:  # every kind befalls every target once before any does so twice
            bag = [(kind, target) for kind in plan.kinds for target in plan.targets]
            rng.shuffle(bag)
        kind, target = bag.pop()
        lasts_s = 0.0 if kind in _MOMENTARY else rng.uniform(*plan.lasts_s)
        if at + lasts_s > length_s - CALM_END_S:
            return troubles
        trouble = Trouble(lane, kind, target, at, lasts_s)
        if at < length_s * SPARED_FROM or not ends_a_judged_process(trouble):
            troubles.append(trouble)
            at += lasts_s + rng.uniform(*plan.rest_s)
        elif lane is Lane.CONTROL:
            return troubles
