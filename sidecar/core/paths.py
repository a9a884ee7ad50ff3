"""One path: where it leads, whether it lives, when to probe it."""

from __future__ import annotations

from typing import TYPE_CHECKING

from sidecar.core.congestion import CongestionController
from sidecar.core.frame import Finished, encode_ack, encode_finished
from sidecar.core.link_events import PathMeasured
from sidecar.core.path_id import PathId, PathState
from sidecar.core.pmtu import PathMtu
from sidecar.core.recovery import Recovery
from sidecar.core.rtt import RttEstimator
from sidecar.core.send_queue import SendQueue
from sidecar.core.timers import NEVER

if TYPE_CHECKING:
    import random

    from protos.model import Address, InterfaceId, NodeName, SessionId
    from sidecar.core.path_keys import PathKeys

IDLE_PROBE_S = 0.5
"""A quiet path is probed this often: keeps NAT bindings open (RFC 4787 asks for 2 minutes, real ones forget after
seconds) and finds a dead path within a second."""
FIRST_PROBE_S = 0.05
"""Probes to a path that is not up start this close together ..."""
MAX_PROBE_S = 1.0
"""... and back off to this, so that a path that comes back is seen within a second."""
PROBE_BACKOFF = 1.5
RETURN_BACKOFF = 1.02
"""A path that was up is likely to come back, and requests may wait for it: its probes are as far apart as a fiftieth of
the time that it is down, 0.25 s after ten seconds. Both ends probe, so that the wait is mostly half of that or less."""
DOWN_FACTOR = 4.0
"""An unstable path is down after this many times the silence that made it unstable, or the longest that anybody waits
beyond that, ..."""
DOWN_FLOOR_S = 0.5
"""... but not before this."""
MAX_PROBES_OUT = 32
"""Unanswered probes that are remembered; older ones could only give stale round-trip times."""
MAX_RTT_SAMPLES = 512
"""Round-trip times kept between two reports."""


class Path:
    """Sender's and receiver's state of one path. Owned by its link."""

    __slots__ = (
        "_introduced",
        "_introducer",
        "_next_probe_id",
        "_probe_gap",
        "_probed_at",
        "_probes_out",
        "_rebound",
        "_waiting_since",
        "_was_up",
        "bytes_sent",
        "candidates",
        "control",
        "finished",
        "id",
        "introductions",
        "keys",
        "mtu",
        "opening",
        "pending",
        "pending_by",
        "probe_at",
        "queue",
        "received",
        "recovery",
        "remote",
        "remote_id",
        "reported_fates",
        "reported_lost",
        "reported_sent",
        "rtts",
        "sealing",
        "session",
        "state",
    )

    def __init__(
        self,
        path_id: PathId,
        session: SessionId,
        keys: PathKeys,
        candidates: tuple[Address, ...],
        first_number: int,
        now: float,
    ) -> None:
        self.id = path_id
        self.remote_id: InterfaceId = path_id.remote
        self.session = session
        self.keys = keys
        self.sealing = keys.sealing
        self.opening = keys.opening
        self.received = keys.received
        self.candidates = candidates
        self.remote: Address | None = None
        """Where the newest authentic datagram came from."""
        self.state = PathState.DOWN
        self.recovery = Recovery(first_number)
        self.control = CongestionController()
        self.mtu = PathMtu()
        self.queue = SendQueue()
        self.introductions: list[tuple[Address, int]] = []
        """Where the peer introduced itself from, and the probe that it wants answered there."""
        self.pending: list[bytes] = []
        """Encoded control frames that wait for the next datagram ..."""
        self.finished: dict[int, None] = {}
        """... and messages to be reported FINISHED in it ..."""
        self.pending_by = NEVER
        """... which leaves at this moment (s) at the latest; NEVER when none waits."""
        self.probe_at: float | None = now
        self.rtts: list[float] = []
        self.bytes_sent = 0
        self.reported_sent = 0
        self.reported_lost = 0
        self.reported_fates = (0, 0)
        self._probe_gap = FIRST_PROBE_S
        self._probed_at = now - FIRST_PROBE_S
        self._next_probe_id = 0
        self._probes_out: dict[int, tuple[float, bool]] = {}
        """When each unanswered probe left, and whether it was sealed with this path's keys."""
        self._introduced = False
        self._introducer: Address | None = None
        self._waiting_since: float | None = None
        self._rebound = False
        self._was_up = False

    @property
    def peer(self) -> NodeName:
        """The node at the other end."""
        return self.id.peer

    def destinations(self) -> tuple[Address, ...]:
        """Where a probe goes now: the known address, or all that may be it while the path is down or just rebound."""
        if self.remote is not None and self.state is not PathState.DOWN and not self._rebound:
            return (self.remote,)
        others = dict.fromkeys((self.remote, self._introducer))
        return (*(one for one in others if one and one not in self.candidates), *self.candidates)

    def keeps_address(self, source: Address) -> bool:
        """Whether an authentic datagram from another of the peer's known addresses is no reason to go there as well.

        It is none while the present one, known as well, answers. An unknown one means that a NAT forgot the peer, or
        that somebody else passes on what it sends: to be left as soon as a datagram comes from a known one.
        """
        known = source in self.candidates and self.remote in self.candidates
        return known and self.state is PathState.UP and not self._rebound

    def note_introduction(self, source: Address, probe_id: int) -> None:
        """The peer introduced itself from here, and wants a probe answered.

        When it does so again although it was answered, it can not read the answer: it does not know yet that we were
        restarted. Behind a NAT it may be reachable there only, so that our own introduction has to go there too.
        """
        self.introductions.append((source, probe_id))
        if self.state is PathState.DOWN:
            self._introducer = source if self._introduced else None
            self._introduced = True

    def next_probe(self, now: float, rng: random.Random) -> int:
        """Return the id of a probe that leaves now, and plan the next one."""
        self._probed_at = now
        probe_id = self._note_probe(now, sealed=self.state is not PathState.DOWN)
        self.waits_for_answer(now)
        if self.state is PathState.UP:
            gap = IDLE_PROBE_S
        elif self.state is PathState.UNSTABLE:
            gap = max(FIRST_PROBE_S, self.recovery.rtt.smoothed)
        else:
            gap = self._probe_gap
            backoff = RETURN_BACKOFF if self._was_up else PROBE_BACKOFF
            self._probe_gap = min(gap * backoff, MAX_PROBE_S)
        self.probe_at = now + gap * rng.uniform(0.9, 1.1)
        return probe_id

    def counter_probe(self, now: float) -> int:
        """Return the id of a sealed probe that leaves now besides those that are planned."""
        return self._note_probe(now, sealed=True)

    def _note_probe(self, now: float, *, sealed: bool) -> int:
        probe_id = self.take_probe_id()
        self._probes_out[probe_id] = now, sealed
        if len(self._probes_out) > MAX_PROBES_OUT:
            del self._probes_out[next(iter(self._probes_out))]
        return probe_id

    def take_probe_id(self) -> int:
        """Return the id of the next probe, of liveness or of size."""
        probe_id = self._next_probe_id
        self._next_probe_id = (probe_id + 1) & 0xFFFFFFFF
        return probe_id

    def hasten_probe(self, now: float) -> None:
        """It is time to ask again. Never sooner than FIRST_PROBE_S after the last time, whoever wishes it."""
        if self.probe_at is not None:
            self.probe_at = min(self.probe_at, max(now, self._probed_at + FIRST_PROBE_S))

    def probe_soon(self, now: float) -> None:
        """The path may have come back: probe at once, and the first ones close together."""
        self._probe_gap = FIRST_PROBE_S
        self.probe_at = now

    def start_afresh(self, now: float) -> None:
        """The way to the peer changed: nothing measured on the old one holds (RFC 9000 section 9.4)."""
        self.recovery.rtt = RttEstimator()
        self.control = CongestionController()
        self._probes_out.clear()
        self._rebound = True
        self.probe_soon(now)
        if self.state is PathState.UP:
            self.state = PathState.UNSTABLE
            self._waiting_since = now

    def answered_probe(self, probe_id: int, now: float) -> bool:
        """A PROBE_REPLY came; False when it answers nothing we asked."""
        probe = self._probes_out.pop(probe_id, None)
        if probe is None:
            return False
        sent_at, sealed = probe
        self.recovery.rtt.sample(now - sent_at, now)
        if sealed:
            self.sealing.delivered(sent_at)
        self.note_rtt()
        return True

    @property
    def control_at(self) -> float:
        """When control frames leave without company (s); NEVER when none wait."""
        ack_at = self.received.ack_at
        return self.pending_by if ack_at is None else min(ack_at, self.pending_by)

    def take_control(self, now: float) -> list[bytes]:
        """Remove and return the control frames that wait, the acknowledgement that is owed included."""
        taken, self.pending = self.pending, []
        taken += [encode_finished(Finished(number)) for number in self.take_pending_finished()]
        if self.received.ack_at is not None:
            taken.append(encode_ack(*self.received.take_ack(now)))
        self.pending_by = NEVER
        return taken

    def take_pending_finished(self) -> tuple[int, ...]:
        """Return which messages are to be reported FINISHED, and forget it."""
        finished = tuple(self.finished)
        self.finished.clear()
        return finished

    def note_rtt(self) -> None:
        """Keep the latest round-trip time for the next report."""
        if len(self.rtts) < MAX_RTT_SAMPLES:
            self.rtts.append(self.recovery.rtt.latest)

    def take_measured(self) -> PathMeasured | None:
        """Return what was measured since the last call; None when nothing was."""
        recovery = self.recovery
        sent, lost = recovery.total_sent, recovery.total_lost
        if not self.rtts and sent == self.reported_sent:
            return None
        measured = PathMeasured(
            self.id,
            recovery.rtt.smoothed,
            tuple(self.rtts),
            sent - self.reported_sent,
            lost - self.reported_lost,
            *self._take_fates(),
        )
        self.rtts.clear()
        self.reported_sent, self.reported_lost = sent, lost
        return measured

    def _take_fates(self) -> tuple[int, int]:
        """Return how many datagrams arrived and were missed since the last call."""
        recovery = self.recovery
        arrived, missed = recovery.total_arrived, recovery.total_missed - recovery.reordering.spurious
        before, self.reported_fates = self.reported_fates, (arrived, missed)
        # Late arrivals may be more than what was missed in the meantime.
        return arrived - before[0], max(0, missed - before[1])

    def waits_for_answer(self, now: float) -> None:
        """Something that wants an answer left."""
        if self._waiting_since is None:
            self._waiting_since = now

    def made_progress(self, now: float) -> bool:
        """The peer proved that our datagrams arrive; True when that brings the path up."""
        self._waiting_since = now if self.recovery.sent else None
        self._rebound = False
        if self.state is PathState.UP:
            if self.probe_at is None or self.probe_at < now + IDLE_PROBE_S / 2:
                self.probe_at = now + IDLE_PROBE_S
            return False
        self.state = PathState.UP
        self._introduced, self._introducer = False, None
        self._was_up = True
        self._probe_gap = FIRST_PROBE_S
        self.probe_at = now + IDLE_PROBE_S
        return True

    @property
    def silence_timer(self) -> float | None:
        """When the present silence makes the path unstable or down."""
        if self._waiting_since is None or self.state is PathState.DOWN:
            return None
        return self._waiting_since + self._limit()

    def _limit(self) -> float:
        rtt = self.recovery.rtt
        limit = rtt.silence_limit()
        if self.state is PathState.UP:
            return limit
        return max(min(DOWN_FACTOR * limit, limit + rtt.longest_wait()), DOWN_FLOOR_S)

    def check_silence(self, now: float) -> PathState | None:
        """Return the new state when the silence changed it."""
        timer = self.silence_timer
        if timer is None or timer > now:
            return None
        if self.state is PathState.UP:
            self.state = PathState.UNSTABLE
        else:
            self.go_down()
        self.probe_at = now
        return self.state

    def go_down(self) -> None:
        """Nothing that is under way brings it up again: only what is asked from now on."""
        self.state = PathState.DOWN
        self._waiting_since = None
        self._probes_out.clear()
        self.mtu.stop()
