"""A running emulated link, seen from outside: change it, darken it, replay a trace on it, question it."""

from __future__ import annotations

import threading
import time
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from lab.errors import LabError
from lab.profile import DropReason, LinkProfile

if TYPE_CHECKING:
    from collections.abc import Callable

    from lab.traces import Trace
    from lab.wire import LineSocket

# A trace of an hour takes the emulator well under a second to swallow.
_ANSWER_TIMEOUT_S = 20.0
# By then every link has its steps, so that the first ones are in time too, seconds.
REPLAY_LEAD_S = 0.5


@dataclass(frozen=True, slots=True)
class DirectionStats:
    """Counters of one direction since the lab began. Bytes are those of IP packets."""

    sent_packets: int
    sent_bytes: int
    delivered_packets: int
    delivered_bytes: int
    drops: dict[DropReason, int]
    queue_bytes: int
    """In front of the bottleneck now."""
    in_flight_packets: int
    """Past the bottleneck, not yet delivered."""
    bypassed_packets: int
    """Multicast and broadcast frames of the kernels (ARP, MLD), let through unemulated."""
    kernel_drops: int
    """Lost before the emulator could read them: anything but 0 says that the emulator was too slow."""
    profile: LinkProfile
    """In force now."""


@dataclass(frozen=True, slots=True)
class Lateness:
    """How late something happened, in seconds."""

    count: int
    p50_s: float
    p99_s: float
    max_s: float


@dataclass(frozen=True, slots=True)
class LinkStats:
    """What the link did, and how far to trust it."""

    up: DirectionStats
    """Host to internet."""
    down: DirectionStats
    """Internet to host."""
    dark: DropReason | None
    """BLACKHOLE or UNPLUGGED while it is so."""
    replaying: bool
    lateness: Lateness
    """Of packets behind their computed departure time, since the last reset."""
    step_lateness: Lateness
    """Of trace steps behind their time, since the last reset."""
    turns: int
    """Turns of the emulator's loop."""
    realtime: bool
    """Whether the emulator goes before ordinary processes (SCHED_RR); if not, mind the lateness."""
    longest_turn_s: float
    """A packet that arrived meanwhile waited so long before its arrival was noticed; since the last reset."""
    cpu_s: float
    """Processor time of the emulator since its start."""


class Link:
    """The emulated link of one interface, made by `Lab`; both directions. Safe to use from any thread."""

    def __init__(
        self,
        host: str,
        interface: str,
        control: LineSocket,
        *,
        up: LinkProfile,
        down: LinkProfile,
        last_words: Callable[[], str],
    ) -> None:
        self.host = host
        self.interface = interface
        self._control = control
        self._first = (up, down)
        self._last_words = last_words  # what the lab's processes wrote on stderr
        self._lock = threading.Lock()
        control.settimeout(_ANSWER_TIMEOUT_S)

    def set(
        self,
        both: LinkProfile | None = None,
        *,
        up: LinkProfile | None = None,
        down: LinkProfile | None = None,
    ) -> None:
        """Change the profile of one or both directions from now on; ends a replay.

        A dark link stays dark; what is set applies after `restore`.
        """
        self._ask("set", up=_profile_json(up or both), down=_profile_json(down or both))

    def change(self, **fields: Any) -> None:
        """Change single fields of `LinkProfile`, both directions, as `change(loss=0.1)`; ends a replay."""
        stats = self.stats()
        self.set(up=replace(stats.up.profile, **fields), down=replace(stats.down.profile, **fields))

    def outage(self) -> None:
        """Rate 0 in both directions: the queues fill, then drop. `change(rate_kbps=...)` ends it."""
        self.change(rate_kbps=0)

    def blackhole(self) -> None:
        """Lose everything silently, what is under way included; the carrier stays up."""
        self._ask("dark", reason=DropReason.BLACKHOLE)

    def unplug(self) -> None:
        """Pull the cable: as `blackhole`, and the interface loses its carrier."""
        self._ask("dark", reason=DropReason.UNPLUGGED)

    def restore(self) -> None:
        """End `blackhole` or `unplug`; profile or replay go on as if nothing had been."""
        self._ask("dark", reason=None)

    def reset(self) -> None:
        """Back to the profiles the lab began with, neither dark nor replaying."""
        self.set(up=self._first[0], down=self._first[1])
        self.restore()

    def replay(self, trace: Trace, path: str, *, start: float | None = None, repeat: bool = False) -> None:
        """Follow a path of a trace; `Lab.replay` does so for several links on one clock.

        Args:
            start: `time.monotonic()` of the trace's second 0; default: `REPLAY_LEAD_S` from now.
            repeat: begin anew at the end instead of keeping the last step.

        Raises:
            LabConfigError: the trace has no such path.
        """
        self._ask(
            "replay",
            steps=[step.to_json() for step in trace.path(path)],
            start=time.monotonic() + REPLAY_LEAD_S if start is None else start,
            repeat_s=trace.duration_s if repeat else None,
        )

    def stats(self, *, reset: bool = False) -> LinkStats:
        """Counters and lateness; `reset` begins the lateness (not the counters) anew."""
        answer = self._ask("stats", reset=reset)
        return LinkStats(
            up=_direction_stats(answer["up"]),
            down=_direction_stats(answer["down"]),
            dark=DropReason(answer["dark"]) if answer["dark"] else None,
            replaying=answer["replaying"],
            lateness=Lateness(**answer["lateness"]),
            step_lateness=Lateness(**answer["step_lateness"]),
            turns=answer["turns"],
            realtime=answer["realtime"],
            longest_turn_s=answer["longest_turn_s"],
            cpu_s=answer["cpu_s"],
        )

    def close(self) -> None:
        """Close the control socket; the emulator ends."""
        self._control.close()

    def _ask(self, op: str, **fields: Any) -> dict[str, Any]:
        with self._lock:
            try:
                self._control.send({"op": op, **fields})
                answer = self._control.receive()
            except ConnectionError:
                answer = None
            except OSError as error:
                raise LabError(f"link {self.host}/{self.interface}: {error}") from error
        if answer is None:
            raise LabError(f"link {self.host}/{self.interface}: its emulator has died\n{self._last_words()}")
        if not answer["ok"]:
            raise LabError(f"link {self.host}/{self.interface}: {answer['error']}")
        return answer


def _profile_json(profile: LinkProfile | None) -> dict[str, Any] | None:
    return None if profile is None else profile.to_json()


def _direction_stats(fields: dict[str, Any]) -> DirectionStats:
    drops = {DropReason(reason): count for reason, count in fields.pop("drops").items()}
    return DirectionStats(drops=drops, profile=LinkProfile.from_json(fields.pop("profile")), **fields)
