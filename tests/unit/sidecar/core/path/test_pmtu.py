"""Path MTU discovery in simulated time, against a path that swallows what is too long."""

from __future__ import annotations

import random
from dataclasses import dataclass, field

import pytest

from plr.sidecar.core.path.pmtu import (
    COMMON_MTUS,
    MAX_PROBES,
    PROBE_TIMEOUT_S,
    PROBES_REMEMBERED,
    RAISE_EVERY_S,
    RETRY_S,
    PathMtu,
    payloads,
)
from plr.sidecar.core.wire.frame import BASE_BYTES, MAX_DATAGRAM_BYTES

RTT_S = 0.05
ETHERNET, JUMBO = payloads(1500, ipv6=False), payloads(9000, ipv6=False)


@dataclass
class Carrier:
    """A path that carries packets of up to `takes` bytes, over an interface of this `mtu`; over IPv4."""

    takes: int
    interface: int
    now: float = 100.0
    loss: float = 0.0
    rng: random.Random = field(default_factory=lambda: random.Random(1))
    mtu: PathMtu = field(default_factory=PathMtu)
    probes: list[tuple[float, int]] = field(default_factory=list)
    next_id: int = 0

    def __post_init__(self) -> None:
        self.mtu.start(payloads(self.interface, ipv6=False), self.now)

    def run(self, seconds: float) -> None:
        """Send every probe that is due until then; what passes is answered a round trip later."""
        end = self.now + seconds
        while self.mtu.timer is not None and self.mtu.timer <= end:
            self.now = max(self.now, self.mtu.timer)
            self.next_id += 1
            size = self.mtu.next_probe(self.next_id, self.now)
            if size is None:
                continue
            assert BASE_BYTES < size <= self.interface - 28
            self.probes.append((self.now, size))
            if size <= self.takes - 28 and self.rng.random() >= self.loss:
                self.now += RTT_S
                assert self.mtu.on_reply(self.next_id, self.now)
        self.now = end

    def lose(self, times: int = 1, *, small_passes: bool = True) -> bool:
        """Lose two full datagrams this often; a small probe is answered between them."""
        lowered = False
        for _ in range(times):
            self.now += RTT_S
            lowered = self.mtu.on_lost(2, self.now) or lowered
            if small_passes:
                self.mtu.on_delivered(60)
        return lowered


@pytest.mark.parametrize(
    ("mtu", "ipv6", "sizes"),
    [
        (1500, False, (1252, 1372, 1392, 1464, 1472)),
        (1500, True, (1232, 1352, 1372, 1444, 1452)),
        (1430, False, (1252, 1372, 1392, 1402)),
        (1280, True, (1232,)),
        (9000, False, (1252, 1372, 1392, 1464, 1472, 4068, MAX_DATAGRAM_BYTES)),
        (65_536, True, (1232, 1352, 1372, 1444, 1452, 4048, MAX_DATAGRAM_BYTES)),
        (1228, False, ()),
        (0, False, ()),
    ],
)
def test_what_is_tried_on_an_interface(mtu: int, ipv6: bool, sizes: tuple[int, ...]) -> None:
    assert payloads(mtu, ipv6=ipv6) == sizes


@pytest.mark.parametrize("mtu", [1280, 1400, 1500, 9000, 65_535])
def test_finds_what_the_interface_takes(mtu: int) -> None:
    carrier = Carrier(takes=mtu, interface=mtu)
    carrier.run(1.0)
    assert carrier.mtu.size == min(mtu - 28, MAX_DATAGRAM_BYTES)
    assert len(carrier.probes) <= len(COMMON_MTUS)


@pytest.mark.parametrize("takes", [1228, 1280, 1300, 1400, 1428, 1480, 1492, 1500, 2000, 5000])
def test_finds_the_common_mtu_below_what_a_router_in_the_middle_takes(takes: int) -> None:
    carrier = Carrier(takes=takes, interface=9000)
    carrier.run(60.0)
    assert carrier.mtu.size == max(mtu - 28 for mtu in (1228, *COMMON_MTUS) if mtu <= takes)
    too_long = [size for _, size in carrier.probes if size > takes - 28]
    assert len(too_long) == MAX_PROBES


def test_starts_at_the_base_and_uses_a_confirmed_size_at_once() -> None:
    mtu = PathMtu()
    assert mtu.size == BASE_BYTES
    assert mtu.timer is None
    mtu.start(ETHERNET, 5.0)
    assert mtu.next_probe(1, 5.0) == 1252
    assert mtu.size == BASE_BYTES
    assert mtu.on_reply(1, 5.1)
    assert mtu.size == 1252
    assert mtu.timer == 5.1


def test_one_probe_at_a_time() -> None:
    mtu = PathMtu()
    mtu.start(ETHERNET, 5.0)
    assert mtu.next_probe(1, 5.0) is not None
    assert mtu.next_probe(2, 5.5) is None
    assert mtu.timer == 5.0 + PROBE_TIMEOUT_S


def test_a_slow_path_gets_more_time() -> None:
    mtu = PathMtu()
    mtu.start(ETHERNET, 5.0)
    mtu.next_probe(1, 5.0, timeout_s=4.0)
    assert mtu.timer == 9.0


def test_lost_probes_are_sent_again() -> None:
    found = 0
    for seed in range(200):
        carrier = Carrier(takes=1500, interface=1500, loss=0.1, rng=random.Random(seed))
        carrier.run(30.0)
        found += carrier.mtu.size == 1472
    assert found >= 197  # each of four sizes fails at one in a thousand


def test_a_late_reply_counts() -> None:
    mtu = PathMtu()
    mtu.start(ETHERNET, 0.0)
    assert mtu.next_probe(1, 0.0) == 1252
    assert mtu.next_probe(2, 1.0) == 1252
    assert mtu.on_reply(1, 1.5)
    assert mtu.size == 1252
    assert mtu.next_probe(3, 1.5) == 1372


def test_replies_to_nothing_asked_change_nothing() -> None:
    mtu = PathMtu()
    mtu.start(ETHERNET, 0.0)
    assert not mtu.on_reply(7, 0.0)
    mtu.next_probe(1, 0.0)
    assert mtu.on_reply(1, 0.1)
    assert not mtu.on_reply(1, 0.1)
    assert mtu.size == 1252


def test_remembers_few_probes() -> None:
    mtu = PathMtu()
    mtu.start(JUMBO, 0.0)
    for number in range(100):
        now = number * RAISE_EVERY_S
        mtu.next_probe(number, now)
    assert len(mtu._out) <= PROBES_REMEMBERED


def test_looks_for_more_from_time_to_time() -> None:
    carrier = Carrier(takes=1400, interface=1500)
    carrier.run(60.0)
    assert carrier.mtu.size == 1372
    carrier.takes = 1500
    carrier.run(RAISE_EVERY_S)
    assert carrier.mtu.size == 1472
    before = len(carrier.probes)
    carrier.run(10 * RAISE_EVERY_S)
    assert len(carrier.probes) == before


def test_an_idle_search_costs_little() -> None:
    carrier = Carrier(takes=1400, interface=1500)
    carrier.run(60.0)
    before = len(carrier.probes)
    carrier.run(10 * RAISE_EVERY_S)
    assert len(carrier.probes) - before <= 10 * MAX_PROBES


def test_a_black_hole_brings_it_back_to_the_base() -> None:
    carrier = Carrier(takes=1500, interface=1500)
    carrier.run(10.0)
    carrier.takes = 1328
    assert carrier.lose(3)
    assert carrier.mtu.size == BASE_BYTES
    carrier.run(RETRY_S + 10)
    assert carrier.mtu.size == 1252


def test_loss_of_everything_is_no_black_hole() -> None:
    carrier = Carrier(takes=1500, interface=1500)
    carrier.run(10.0)
    assert not carrier.lose(100, small_passes=False)
    assert carrier.mtu.size == 1472


def test_one_burst_is_no_black_hole() -> None:
    carrier = Carrier(takes=1500, interface=1500)
    carrier.run(10.0)
    carrier.mtu.on_delivered(60)
    assert not carrier.mtu.on_lost(100, carrier.now)


def test_random_loss_is_no_black_hole() -> None:
    carrier = Carrier(takes=1500, interface=1500)
    carrier.run(10.0)
    rng = random.Random(3)
    for _ in range(100_000):
        if rng.random() < 0.05:
            assert not carrier.mtu.on_lost(1, carrier.now)
        else:
            carrier.mtu.on_delivered(1472)
        carrier.mtu.on_delivered(60)
    assert carrier.mtu.size == 1472


def test_a_path_that_flaps_is_tried_less_and_less_often() -> None:
    carrier = Carrier(takes=1500, interface=1500)
    carrier.run(10.0)
    waits = []
    for _ in range(12):
        assert carrier.lose(3)
        since = carrier.now
        assert carrier.mtu.timer is not None
        waits.append(carrier.mtu.timer - since)
        carrier.run(waits[-1] + 10)
        assert carrier.mtu.size == 1472
    assert waits[:3] == pytest.approx([RETRY_S, 2 * RETRY_S, 4 * RETRY_S])
    assert max(waits) <= RAISE_EVERY_S


def test_a_black_hole_long_ago_is_forgiven() -> None:
    carrier = Carrier(takes=1500, interface=1500)
    carrier.run(10.0)
    for _ in range(2):
        assert carrier.lose(3)
        assert carrier.mtu.timer == carrier.now + RETRY_S
        carrier.run(2 * RAISE_EVERY_S)


def test_replies_from_before_the_black_hole_prove_nothing() -> None:
    carrier = Carrier(takes=1500, interface=9000)
    carrier.run(0.5)
    assert carrier.mtu.size == 1472
    assert carrier.lose(3)
    assert not any(carrier.mtu.on_reply(number, carrier.now) for number in range(carrier.next_id + 1))
    assert carrier.mtu.size == BASE_BYTES


def test_losses_at_the_base_are_not_its_business() -> None:
    mtu = PathMtu()
    mtu.start((), 0.0)
    for _ in range(10):
        assert not mtu.on_lost(10, 1.0)
        mtu.on_delivered(60)
    assert mtu.next_probe(1, 0.0) is None


def test_the_kernel_says_too_big() -> None:
    carrier = Carrier(takes=1500, interface=1500)
    carrier.run(10.0)
    assert carrier.mtu.on_too_big(1472, carrier.now)
    assert carrier.mtu.size == 1464
    assert not carrier.mtu.on_too_big(1472, carrier.now)
    assert not carrier.mtu.on_too_big(BASE_BYTES, carrier.now)
    carrier.run(10.0)
    assert carrier.mtu.size == 1464


def test_the_kernel_refuses_a_probe() -> None:
    mtu = PathMtu()
    mtu.start(JUMBO, 0.0)
    for number in range(6):
        size = mtu.next_probe(number, 0.0)
        assert size is not None
        if size > 1472:
            assert not mtu.on_too_big(size, 0.0)
        else:
            mtu.on_reply(number, 0.0)
    assert mtu.size == 1472
    assert mtu.next_probe(99, 0.0) is None


def test_down_means_back_to_the_base_and_no_probes() -> None:
    carrier = Carrier(takes=1500, interface=1500)
    carrier.run(10.0)
    assert carrier.mtu.stop()
    assert not carrier.mtu.stop()
    assert (carrier.mtu.size, carrier.mtu.timer) == (BASE_BYTES, None)
    assert carrier.mtu.next_probe(999, carrier.now) is None
    carrier.mtu.start(ETHERNET, carrier.now)
    carrier.run(1.0)
    assert carrier.mtu.size == 1472


def test_the_interface_changes_its_mtu() -> None:
    carrier = Carrier(takes=1500, interface=1500)
    carrier.run(10.0)
    assert carrier.mtu.start(payloads(1280, ipv6=False), carrier.now)
    assert carrier.mtu.size == 1252
    assert not carrier.mtu.start(ETHERNET, carrier.now)
    carrier.run(1.0)
    assert carrier.mtu.size == 1472
    assert not carrier.mtu.start(ETHERNET, carrier.now)
