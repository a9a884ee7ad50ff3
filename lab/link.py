"""Controls a running emulated link: changes it, darkens it, replays a trace on it, reads its counters."""

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

# The emulator reads an hour's trace in well under a second.
_ANSWER_TIMEOUT_S = 20.0
# Seconds before a replay starts: every link has its steps by then, so that even the first ones are on time.
REPLAY_LEAD_S = 0.5


@dataclass(frozen=True, slots=True)
class DirectionStats:
    """Counters of one direction since the lab began. Bytes count IP packets."""

    sent_packets: int
    sent_bytes: int
    delivered_packets: int
    delivered_bytes: int
    drops: dict[DropReason, int]
    queue_bytes: int
    """Bytes in front of the bottleneck now."""
    in_flight_packets: int
    """Packets past the bottleneck that are not yet delivered."""
    bypassed_packets: int
    """Multicast and broadcast frames of the kernels (ARP, MLD), let through unemulated."""
    kernel_drops: int
    """Frames lost before the emulator could read them: anything but 0 means that the emulator was too slow."""
    profile: LinkProfile
    """Profile in force now."""


@dataclass(frozen=True, slots=True)
class Lateness:
    """How late something happened, in seconds."""

    count: int
    p50_s: float
    p99_s: float
    max_s: float


@dataclass(frozen=True, slots=True)
class LinkStats:
    """What the link did, and how far to trust its figures."""

    up: DirectionStats
    """Host to internet."""
    down: DirectionStats
    """Internet to host."""
    dark: DropReason | None
    """BLACKHOLE or UNPLUGGED while the link is dark."""
    replaying: bool
    lateness: Lateness
    """Lateness of packets against their computed departure times, since the last reset."""
    step_lateness: Lateness
    """Lateness of trace steps, since the last reset."""
    turns: int
    """Turns of the emulator's loop."""
    realtime: bool
    """Whether the emulator takes precedence over ordinary processes (SCHED_RR); if not, mind the lateness."""
    longest_turn_s: float
    """Longest turn since the last reset: a packet that arrived during it was noticed only at its end."""
    cpu_s: float
    """Processor time of the emulator since its start."""


class Link:
    """Both directions of the emulated link of one interface, made by `Lab`. Safe to use from any thread."""

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
        self._last_words = last_words  # what the lab's processes wrote to stderr
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
        """Change single fields of `LinkProfile` in both directions, as in `change(loss=0.1)`; ends a replay."""
        stats = self.stats()
        self.set(up=replace(stats.up.profile, **fields), down=replace(stats.down.profile, **fields))

    def outage(self) -> None:
        """Set the rate to 0 in both directions: the queues fill, then drop. `change(rate_kbps=...)` ends it."""
        self.change(rate_kbps=0)

    def blackhole(self) -> None:
        """Lose everything silently, including packets under way; the carrier stays up."""
        self._ask("dark", reason=DropReason.BLACKHOLE)

    def unplug(self) -> None:
        """Pull the cable: like `blackhole`, and the interface loses its carrier."""
        self._ask("dark", reason=DropReason.UNPLUGGED)

    def restore(self) -> None:
        """End `blackhole` or `unplug`; profile or replay continue as if nothing had happened."""
        self._ask("dark", reason=None)

    def reset(self) -> None:
        """Return to the profiles that the lab began with, neither dark nor replaying."""
        self.set(up=self._first[0], down=self._first[1])
        self.restore()

    def replay(self, trace: Trace, path: str, *, start: float | None = None, repeat: bool = False) -> None:
        """Follow a path of a trace; `Lab.replay` does so for several links on one clock.

        Args:
            start: `time.monotonic()` of the trace's second 0; default: `REPLAY_LEAD_S` from now.
            repeat: start over at the end instead of keeping the last step.

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
        """Return counters and lateness; `reset` restarts the lateness (not the counters)."""
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
