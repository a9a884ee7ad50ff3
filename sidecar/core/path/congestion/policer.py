"""Finds the token rate of a policer on one path: carriers drop what exceeds a token bucket, without queueing it.

The bucket is empty whenever it drops. So what arrives of the bytes that left between two losses, while there was always
something to send, is what the tokens allowed; and below that rate nothing is dropped. Random loss looks the same at one
rate, but does not end at a lower one, so a rate found is tried first. (After Flach et al., "An Internet-Wide Analysis
of Traffic Policing", 2016, and the long-term bandwidth of BBRv1. Times are those of sending: a bucket knows of no
acknowledgements.)
"""

from __future__ import annotations

from collections import deque

from plr.sidecar.core.path.congestion.units import DATAGRAM_BYTES

SUSPECT_LOSS = 0.1
"""Losing this share is worth a trial. A sender that knows of no policer hardly loses less to it; radios mostly do."""
KNOWN_LOSS = 0.02
"""The same share once a policer is known, below its rate (the loss threshold of draft-ietf-ccwg-bbr)."""
SUSPECT_BYTES = 12 * DATAGRAM_BYTES
"""Fewer losses give no share."""
SUSPECT_RUNS = 3
RUNS_S, RUNS_ROUNDS = 0.75, 4.0
"""Number of losses with an arrival between them, within this time or as many round trips. A bucket drops the excess now
and then, for as long as too much is sent; a radio that fades for a moment loses everything, once."""
MEMORY_BYTES = 400 * DATAGRAM_BYTES
"""Bytes over which the share is measured while no policer is known."""
SPAN_BYTES = 10 * DATAGRAM_BYTES
SPAN_S = 0.01
"""A rate of less is noise."""
EXACT_BYTES = 30 * DATAGRAM_BYTES
EXACT_S = 0.1
"""Measured over this much, a rate is known to MARGIN; or over this time, if the rate carries less than that in it."""
TRIAL_LOSSES = 12
"""A trial lasts for as many datagrams as would lose this many if the losses were random."""
RANDOM = 0.6
"""The losses are random if at least this share of them goes on in the trial ..."""
POLICED = 0.25
"""... and not if at most this share does. Between the two, the rate found is too high, and a lower one is tried. A path
with random loss passes for policed once in 400 trials (Poisson, three or fewer of twelve)."""
IN_VAIN = 3
"""A supposed policer whose losses go on below this many rates, each lower than the last, with bursts that any bucket
holds, is none: a radio that is silent for 50 ms now and then loses much before a trial, and nothing in it. Each such
rate would be lower, without an end."""
TRY_AGAIN_S = 20.0
"""After random losses, a trial comes only after this time, or when twice as much is lost ..."""
MAX_TRY_AGAIN_S = 640.0
"""... and after rates tried in vain, after twice the previous time, up to this."""
MARGIN = 0.97
"""Share of the token rate that is used: earlier losses refill the bucket, and the measurement is good to a few percent.
"""
GROWTH = 0.03 / 8
"""Search for more: the share of the rate added after `t` units of time, per cubed unit. It reaches the measured rate
after two units, ..."""
FORGET = 2.0
"""... and this many times it after six and a half. Then the policer counts as gone."""
UNIT_S = 1.0
UNIT_ROUNDS = 10.0
UNIT_BYTES = 100 * DATAGRAM_BYTES
"""A unit is the longest of these: whatever asking for too much loses is lost for some round trips."""
CHANGE_ROUNDS = 2.0
"""Losses below the rate are not judged sooner than this after it was set: the bucket is still empty."""
BURST_S = 0.025
LEAST_BURST = 2 * DATAGRAM_BYTES
"""What the rate allows in BURST_S may leave at once at first, as without a policer. It halves whenever losses begin
below the rate: then the bucket holds less."""
SMALL_BURST = 16_000
"""Buckets hold no less (bytes): losses that go on with bursts of this size are not due to bursts."""
CUT = 0.9
"""What is left of the rate then, if the burst is already the least and the rate could not be measured."""
MAX_REMEMBERED = 64
"""Acknowledgements, and pauses for lack of data, that are remembered to measure a span."""


class _Fates:
    """Bytes whose fate is known, among those that left after some moment."""

    __slots__ = ("known", "lost", "since")

    def __init__(self, since: float) -> None:
        self.since = since
        self.known = self.lost = 0

    def note(self, size: int, sent_at: float, *, lost: bool) -> None:
        if sent_at > self.since:
            self.known += size
            self.lost += size if lost else 0

    @property
    def share(self) -> float:
        return self.lost / max(self.known, 1)


class Policer:
    """What one path's losses without a queue tell. Sizes in bytes, rates in bytes a second, times in seconds."""

    __slots__ = (
        "_acks",
        "_asked_s",
        "_before",
        "_delivered",
        "_dry",
        "_fates",
        "_found_share",
        "_in_vain",
        "_lost_at",
        "_overrun_at",
        "_paused",
        "_random",
        "_rejected_at",
        "_round_at",
        "_rtt_s",
        "_runs",
        "_span",
        "_token_rate",
        "_trains",
        "_tried_share",
        "_try_again_s",
        "_usual",
        "burst",
        "was_found",
    )

    def __init__(self) -> None:
        self.burst = 0.0
        """Bytes that may leave at once, if a policer is known."""
        self.was_found = False
        """Whether a trial showed that earlier losses were a policer's; whoever acts on it resets it."""
        self._token_rate = self._before = 0.0
        """The token rate, 0 while no policer is known; and its value before the current trial."""
        self._fates = _Fates(float("-inf"))
        self._tried_share: float | None = None
        """Share lost before the current trial; None: there is none."""
        self._found_share = 0.0
        """Share lost before the trial that found the policer."""
        self._usual = 0.0
        """Share lost below the token rate."""
        self._random = 0.0
        self._rejected_at = float("-inf")
        """Share of random loss, and when a trial showed it."""
        self._try_again_s = TRY_AGAIN_S
        self._in_vain = 0
        """Lower rates tried in a row with the least bursts, since one held."""
        self._lost_at = float("-inf")
        """When the newest lost datagram left."""
        self._runs: deque[float] = deque(maxlen=SUSPECT_RUNS)
        """When the first of each of the last losses left; each pair has an arrival between it."""
        self._overrun_at: float | None = None
        """When the search for more met the policer again; its rate is measured then."""
        self._asked_s = 0.0
        """How long the token rate has held back what there is to send."""
        self._delivered = 0
        self._acks: deque[tuple[float, int]] = deque(maxlen=MAX_REMEMBERED)
        """For some send times, the bytes delivered of what had left by then."""
        self._trains: deque[float] = deque(maxlen=MAX_REMEMBERED)
        """When something left after a pause for lack of data."""
        self._span: tuple[float, int] | None = None
        """The loss since which the rate is measured: when it left, and the bytes delivered of what left before."""
        self._paused = self._dry = True
        """Whether nothing waits to be sent; whether that was so in this round."""
        self._round_at = 0.0
        self._rtt_s = 0.0

    # -- queries --------------------------------------------------------------------------------------------------

    @property
    def rate(self) -> float | None:
        """Bytes a second that may be sent; None while no policer is known."""
        return self._token_rate * self._gain if self._token_rate else None

    @property
    def _gain(self) -> float:
        return MARGIN + GROWTH * float((self._asked_s / self._unit_s) ** 3)

    @property
    def _unit_s(self) -> float:
        return max(UNIT_S, UNIT_ROUNDS * self._rtt_s, UNIT_BYTES / self._token_rate)

    # -- inputs ---------------------------------------------------------------------------------------------------

    def ran_dry(self) -> None:
        """Note that nothing waits to be sent."""
        self._paused = self._dry = True

    def on_sent(self, now: float) -> None:
        """Note that something left."""
        if self._paused:
            self._paused = False
            self._trains.append(now)

    def on_acked(self, size: int, sent_at: float) -> None:
        """Take newly acknowledged bytes, the newest of them sent at `sent_at`."""
        self._delivered += size
        self._acks.append((sent_at, self._delivered))
        fates = self._fates
        fates.note(size, sent_at, lost=False)
        if not self._token_rate and fates.known > MEMORY_BYTES:
            fates.known //= 2
            fates.lost //= 2

    def on_lost(self, size: int, sent_at: float, rtt_s: float, now: float, *, queued: bool) -> bool:
        """Take a loss, the newest datagram of it sent at `sent_at`; return True if a trial begins.

        `queued`: it may have met a queue, which is handled elsewhere.
        """
        self._rtt_s = rtt_s
        trial = self._tried_share is not None
        if trial or not queued:  # a loss that the lower rate did not prevent counts, whatever it met
            self._fates.note(size, sent_at, lost=True)
            self._note_run(sent_at)
        if queued:
            self._span = None
            return False
        if trial or (self._token_rate and sent_at <= self._fates.since):
            return False
        if self._token_rate and self._gain > 1:
            self._on_overrun(sent_at, now)
            return False
        measured = self._measure(sent_at)
        if self._span is None:
            self._span = sent_at, self._delivered_by(sent_at)
            return False
        if not self._is_suspect(now):
            if measured and not self._token_rate:
                self._span = sent_at, self._delivered_by(sent_at)
            return False
        return self._try(measured, sent_at, now)

    def on_spurious(self, size: int) -> None:
        """Undo a supposed loss that was only overtaken: a trial because of it is void, and its end tells nothing."""
        self._fates.lost = max(0, self._fates.lost - size)
        if self._tried_share is not None:
            self._tried_share = None
            self._token_rate = self._before

    def end_round(self, now: float) -> None:
        """End a round trip."""
        elapsed, self._round_at = now - self._round_at, now
        dry, self._dry = self._dry, False
        if not self._token_rate:
            return
        if self._tried_share is not None:
            if self._fates.known * self._tried_share >= TRIAL_LOSSES * DATAGRAM_BYTES:
                self._judge(self._tried_share, now)
        elif self._overrun_at is not None:
            if now - self._overrun_at > self._unit_s:
                if any(train > self._overrun_at for train in self._trains):
                    self._set(self._token_rate, now, now)  # not enough was sent to measure more
                else:
                    self._overrun_at = None  # nothing more was lost
        elif not dry:
            below = self._gain <= 1
            self._asked_s += elapsed
            if below and self._gain > 1:
                self._usual = self._fates.share
                self._fates = _Fates(now)
                self._in_vain = 0
                self._try_again_s = TRY_AGAIN_S
            elif self._gain > FORGET:
                self._token_rate = 0.0

    # -- trials ---------------------------------------------------------------------------------------------------

    def _is_suspect(self, now: float) -> bool:
        least = KNOWN_LOSS if self._token_rate else SUSPECT_LOSS
        if now - self._rejected_at < self._try_again_s:
            least = max(least, 2 * self._random)
        fates = self._fates
        return fates.lost >= SUSPECT_BYTES and fates.share >= least and self._go_on()

    def _go_on(self) -> bool:
        """Return whether the losses are spread over more than one moment."""
        runs = self._runs
        return len(runs) == SUSPECT_RUNS and runs[-1] - runs[0] <= max(RUNS_S, RUNS_ROUNDS * self._rtt_s)

    def _note_run(self, sent_at: float) -> None:
        if self._delivered_by(sent_at) > self._delivered_by(self._lost_at):
            self._runs.append(sent_at)
        self._lost_at = max(self._lost_at, sent_at)

    def _try(self, measured: float | None, sent_at: float, now: float) -> bool:
        """Send no faster than what arrived, and see whether the losses end."""
        known = self._token_rate
        if measured is None:
            if not known or now - self._fates.since < CHANGE_ROUNDS * self._rtt_s:
                return False
            measured = known if self.burst > LEAST_BURST else CUT * known
        if known and self.burst <= SMALL_BURST:
            self._in_vain += 1
            if self._in_vain > IN_VAIN:
                self._give_up(now)
                return False
        self.burst = max(self.burst / 2, LEAST_BURST) if known else BURST_S * measured
        self._tried_share = self._fates.share
        self._before = known
        self._set(measured, sent_at, now)
        return True

    def _give_up(self, now: float) -> None:
        """Reject the policer: the losses go on, whatever the rate."""
        self._random, self._rejected_at = self._fates.share, now
        self._try_again_s = min(2 * self._try_again_s, MAX_TRY_AGAIN_S)
        self._token_rate = 0.0
        self._in_vain = 0
        self._fates = _Fates(now)
        self._span = None

    def _judge(self, tried_share: float, now: float) -> None:
        share = self._fates.share
        self._fates = _Fates(now)
        if share >= RANDOM * tried_share and (not self._before or self.burst <= SMALL_BURST):
            # As much as before the trial that found the policer: that one was chance.
            self._token_rate = 0.0 if share >= RANDOM * self._found_share else self._before
            self._random, self._rejected_at = max(tried_share, share), now
            self._tried_share = None
        elif share > POLICED * tried_share:
            self.burst = max(self.burst / 2, LEAST_BURST) if self._before else self.burst
            sent_at, _ = self._acks[-1]
            measured = self._measure(sent_at)
            self._set(min(self._token_rate, measured or self._token_rate), sent_at, now)
            self._tried_share = share
        else:
            self._tried_share = None
            self._random = 0.0
            if not self._before:
                self._found_share = tried_share
            self.was_found = True

    def _on_overrun(self, sent_at: float, now: float) -> None:
        """Take a loss above the rate: the bucket is empty. Keep this rate until the next loss gives the current one."""
        fates = self._fates
        if self._overrun_at is None:
            if fates.lost > 2 * self._usual * fates.known + DATAGRAM_BYTES:
                self._overrun_at = now
                self._span = sent_at, self._delivered_by(sent_at)
            return
        measured = self._measure(sent_at, min(EXACT_BYTES, max(SPAN_BYTES, EXACT_S * self._token_rate)))
        if measured or self._span is None:
            self._set(min(measured or self._token_rate, self._token_rate * self._gain), sent_at, now)

    def _set(self, rate: float, sent_at: float, now: float) -> None:
        self._token_rate = rate
        self._asked_s = 0.0
        self._overrun_at = None
        self._fates = _Fates(now)
        self._span = sent_at, self._delivered_by(sent_at)

    # -- measuring ------------------------------------------------------------------------------------------------

    def _measure(self, sent_at: float, least: float = SPAN_BYTES) -> float | None:
        """Return the rate of what left since the span began, as far as it arrived; None if that tells nothing."""
        if self._span is None:
            return None
        at, before = self._span
        if any(at < train <= sent_at for train in self._trains):
            self._span = None  # during the pause, the bucket may have been full
            return None
        delivered = self._delivered_by(sent_at) - before
        return delivered / (sent_at - at) if sent_at - at >= SPAN_S and delivered >= least else None

    def _delivered_by(self, sent_at: float) -> int:
        for at, delivered in reversed(self._acks):
            if at <= sent_at:
                return delivered
        return self._acks[0][1] if self._acks else 0
