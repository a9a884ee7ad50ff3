"""A bottleneck in simulated time: one queue with a rate and a buffer, shared by flows of ours and of TCP."""

from __future__ import annotations

import heapq
import random
from itertools import count
from typing import TYPE_CHECKING

from plr.sidecar.core.path.congestion.choice import CONTROLLERS, DEFAULT_CONTROLLER
from plr.sidecar.core.path.congestion.controller import RateSample
from plr.sidecar.core.path.congestion.rtt import RttEstimator

if TYPE_CHECKING:
    from collections.abc import Callable

SIZE = 1200


class Bottleneck:
    """Drop-tail queue, then a fixed delay; acknowledgements come back without loss."""

    def __init__(self, rate: float, rtt_s: float, buffer: float, loss: float = 0.0, seed: int = 1) -> None:
        self.rate = rate
        self.rtt_s = rtt_s
        self.buffer = buffer
        self.loss = loss
        self.rng = random.Random(seed)
        self.now = 0.0
        self.busy_until = 0.0
        self.dropped = 0
        self.queue_s: list[tuple[float, float]] = []
        self._due: list[tuple[float, int, Callable[[], None]]] = []
        self._order = count()

    def at(self, when: float, act: Callable[[], None]) -> None:
        heapq.heappush(self._due, (when, next(self._order), act))

    def carry(self, size: int, arrived: Callable[[], None]) -> None:
        """Send a datagram; `arrived` is called when its acknowledgement is back, unless it is lost."""
        wait = max(0.0, self.busy_until - self.now)
        if wait * self.rate + size > self.buffer + SIZE:
            self.dropped += 1
            return
        self.busy_until = self.now + wait + size / self.rate
        self.queue_s.append((self.now, wait))
        if self.rng.random() >= self.loss:
            self.at(self.busy_until + self.rtt_s, arrived)

    def run(self, until: float) -> None:
        while self._due and self._due[0][0] <= until:
            self.now, _, act = heapq.heappop(self._due)
            act()
        self.now = until

    def mean_queue_s(self, since: float) -> float:
        waits = [wait for at, wait in self.queue_s if at >= since]
        return sum(waits) / len(waits) if waits else 0.0


class Policed(Bottleneck):
    """A token bucket drops what exceeds it, before a link that is 20 times as fast."""

    def __init__(self, rate: float, rtt_s: float, bucket: float, loss: float = 0.0, seed: int = 1) -> None:
        super().__init__(20 * rate, rtt_s, 20 * rate, loss, seed)
        self.token_rate = rate
        self.bucket = self.tokens = bucket
        self.offered = self.policed = 0
        self.first_drop_at: float | None = None
        self._filled_at = 0.0

    def carry(self, size: int, arrived: Callable[[], None]) -> None:
        self.offered += size
        self.tokens = min(self.bucket, self.tokens + (self.now - self._filled_at) * self.token_rate)
        self._filled_at = self.now
        if self.tokens < size:
            self.policed += size
            self.first_drop_at = self.now if self.first_drop_at is None else self.first_drop_at
            return
        self.tokens -= size
        super().carry(size, arrived)


class Flow:
    """What both kinds of sender share: numbers, losses by the packet threshold, a probe timeout."""

    def __init__(self, net: Bottleneck) -> None:
        self.net = net
        self.sent: dict[int, float] = {}
        self.next = 0
        self.largest = -1
        self.delivered = 0
        self.rtt = RttEstimator()
        self._heard_at = 0.0
        self._armed = False

    @property
    def in_flight(self) -> int:
        return len(self.sent) * SIZE

    def transmit(self) -> None:
        number, self.next = self.next, self.next + 1
        self.sent[number] = self.net.now
        self.net.carry(SIZE, lambda: self.acked(number))

    def acked(self, number: int) -> None:
        now = self._heard_at = self.net.now
        sent_at = self.sent.pop(number, None)
        self.largest = max(self.largest, number)
        if sent_at is not None:
            self.delivered += SIZE
            self.rtt.sample(now - sent_at, now)
            self.on_acked(sent_at)
        lost = []
        for other in self.sent:
            if self.largest - other < 3:
                break
            lost.append(other)
        self.lose(lost)
        self.pump()

    def watch(self) -> None:
        """Give up what is in flight when nothing was heard for long."""
        if self.sent:
            since = max(self._heard_at, next(iter(self.sent.values())))
            if self.net.now - since > self.rtt.probe_timeout(0.005) + 0.1:
                self.lose(list(self.sent))
        self.pump()
        self.net.at(self.net.now + 0.05, self.watch)

    def lose(self, numbers: list[int]) -> None:
        if numbers:
            sent_at = max(self.sent.pop(number) for number in numbers)
            self.on_lost(len(numbers) * SIZE, sent_at)

    def on_acked(self, sent_at: float) -> None:
        raise NotImplementedError

    def on_lost(self, size: int, sent_at: float) -> None:
        raise NotImplementedError

    def pump(self) -> None:
        raise NotImplementedError


class OurFlow(Flow):
    """A bulk sender, or with `want` set one that sends only so many bytes."""

    def __init__(self, net: Bottleneck, controller: str = DEFAULT_CONTROLLER) -> None:
        super().__init__(net)
        self.control = CONTROLLERS[controller]()
        self.want: int | None = None
        self._timer = 0.0

    def on_acked(self, sent_at: float) -> None:
        now = self.net.now
        self.control.on_acked(RateSample(SIZE, sent_at, now - sent_at, self.in_flight), self.rtt, now)

    def on_lost(self, size: int, sent_at: float) -> None:
        if self.want is not None:
            self.want += size
        self.control.on_lost(size, sent_at, self.in_flight, self.net.now)

    def pump(self) -> None:
        net, control = self.net, self.control
        budget = control.budget(net.now, self.in_flight)
        while budget >= SIZE:
            if self.want is not None:
                if self.want <= 0:
                    control.ran_dry()
                    return
                self.want -= SIZE
            self.transmit()
            control.on_sent(net.now, SIZE, self.in_flight)
            budget -= SIZE
        release = control.next_release(self.in_flight)
        if release is not None and release > net.now and not net.now < self._timer <= release:
            self._timer = release
            net.at(release, self.pump)


class Tcp(Flow):
    """A bulk sender as RFC 9438 (CUBIC) or RFC 5681 (Reno) have it, with selective acknowledgements."""

    def __init__(self, net: Bottleneck, *, cubic: bool) -> None:
        super().__init__(net)
        self.cubic = cubic
        self.window = 10.0
        self.threshold = float("inf")
        self.recover = -1
        self._top = 0.0
        self._epoch = 0.0

    def on_acked(self, sent_at: float) -> None:
        if self.window < self.threshold:
            self.window += 1
            return
        if not self.cubic:
            self.window += 1 / self.window
            return
        k = (self._top * 0.3 / 0.4) ** (1 / 3)
        t = self.net.now - self._epoch + self.rtt.smoothed
        target = 0.4 * (t - k) ** 3 + self._top
        reno = 0.7 * self._top + 3 * 0.3 / 1.7 * (self.net.now - self._epoch) / self.rtt.smoothed
        target = max(target, reno)
        if target > self.window:
            self.window += min((target - self.window) / self.window, 0.5)
        else:
            self.window += 0.01 / self.window

    def on_lost(self, size: int, sent_at: float) -> None:
        if self.largest < self.recover:
            return
        self.recover = self.next
        self._top = self.window
        self._epoch = self.net.now
        self.window = self.threshold = max(2.0, self.window * (0.7 if self.cubic else 0.5))

    def pump(self) -> None:
        while len(self.sent) < self.window:
            self.transmit()
