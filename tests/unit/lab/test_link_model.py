"""The emulated link's decisions, in simulated time."""

from __future__ import annotations

from random import Random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from lab import model as model_module
from lab.model import LinkModel
from lab.profile import DropReason, LinkProfile

# Sums of floating-point times: far below anything a clock resolves.
EPSILON_S = 1e-9


def make(seed: int = 1, **fields: float | int | None) -> LinkModel:
    return LinkModel(LinkProfile.from_json(fields), Random(seed))


def packet(number: int) -> bytes:
    return number.to_bytes(4, "big")


def times(due: list[tuple[float, bytes]]) -> list[float]:
    return [at for at, _ in due]


def numbers(due: list[tuple[float, bytes]]) -> list[int]:
    return [int.from_bytes(data, "big") for _, data in due]


def test_without_limits_a_packet_leaves_at_once() -> None:
    link = make()
    link.send(5.0, packet(1), 1200)
    assert link.next_departure() == 5.0
    assert link.pop_due(5.0) == [(5.0, packet(1))]
    assert link.next_departure() is None


def test_delay_holds_a_packet_back_until_its_time() -> None:
    link = make(delay_ms=20)
    link.send(1.0, packet(1), 100)
    assert link.pop_due(1.019) == []
    assert times(link.pop_due(1.0201)) == pytest.approx([1.02])


def test_rate_spaces_packets_by_their_length() -> None:
    link = make(rate_kbps=8)  # 1000 bytes a second
    for number in range(3):
        link.send(0.0, packet(number), 500)
    assert times(link.pop_due(10.0)) == pytest.approx([0.5, 1.0, 1.5])


def test_idle_time_of_the_bottleneck_is_not_saved_up() -> None:
    link = make(rate_kbps=8)
    link.send(100.0, packet(0), 1000)
    link.send(100.0, packet(1), 1000)
    assert times(link.pop_due(200.0)) == pytest.approx([101.0, 102.0])


def test_full_queue_drops_the_newest() -> None:
    link = make(rate_kbps=8, queue_bytes=2500)
    for number in range(4):
        link.send(0.0, packet(number), 1000)
    assert link.drops[DropReason.QUEUE_FULL] == 2
    assert numbers(link.pop_due(10.0)) == [0, 1]


def test_queue_has_room_again_when_a_packet_has_been_sent() -> None:
    link = make(rate_kbps=8, queue_bytes=2000)
    for at in (0.0, 0.0, 0.999, 1.0):
        link.send(at, packet(0), 1000)
    assert link.drops[DropReason.QUEUE_FULL] == 1
    assert link.queue_bytes == 2000


def test_outage_fills_the_queue_then_drops_and_ends_with_what_was_kept() -> None:
    link = make(rate_kbps=8)
    link.set_profile(0.0, LinkProfile(rate_kbps=0, queue_bytes=3000))
    for number in range(5):
        link.send(1.0, packet(number), 1000)
    assert link.next_departure() is None
    assert link.pop_due(1000.0) == []
    link.set_profile(1000.0, LinkProfile(rate_kbps=8))
    assert link.next_departure() == pytest.approx(1001.0)
    assert numbers(link.pop_due(2000.0)) == [0, 1, 2]
    assert link.drops[DropReason.QUEUE_FULL] == 2


def test_rate_change_under_way_counts_the_bits_already_sent() -> None:
    link = make(rate_kbps=8)
    link.send(0.0, packet(0), 1000)  # would take 1 s
    link.set_profile(0.5, LinkProfile(rate_kbps=4))  # half is left, at half the rate
    assert link.next_departure() == pytest.approx(1.5)


def test_lifting_the_rate_limit_releases_the_queue() -> None:
    link = make(rate_kbps=0)
    link.send(0.0, packet(0), 1000)
    link.send(0.0, packet(1), 1000)
    link.set_profile(3.0, LinkProfile(delay_ms=10))
    due = link.pop_due(4.0)
    assert times(due) == pytest.approx([3.01, 3.01])
    assert numbers(due) == [0, 1]
    assert link.queue_bytes == 0


def test_shorter_delay_lets_no_packet_overtake() -> None:
    link = make(delay_ms=500)
    link.send(0.0, packet(0), 100)
    link.set_profile(0.1, LinkProfile(delay_ms=10))
    link.send(0.1, packet(1), 100)
    assert link.pop_due(0.4) == []
    assert numbers(link.pop_due(0.5)) == [0, 1]


def test_dark_link_loses_what_is_queued_in_flight_and_sent() -> None:
    link = make(rate_kbps=8, delay_ms=10_000)
    link.send(0.0, packet(0), 1000)
    link.send(0.0, packet(1), 1000)
    link.set_dark(1.5, DropReason.BLACKHOLE)  # one in flight, one in the queue
    link.send(2.0, packet(2), 1000)
    assert link.next_departure() is None
    link.set_dark(3.0, None)
    link.send(3.0, packet(3), 1000)
    assert link.drops[DropReason.BLACKHOLE] == 3
    due = link.pop_due(100.0)
    assert times(due) == pytest.approx([14.0])
    assert numbers(due) == [3]


def test_light_again_does_not_wait_for_packets_lost_in_the_dark() -> None:
    link = make(delay_ms=60_000)
    link.send(0.0, packet(0), 100)
    link.set_dark(1.0, DropReason.UNPLUGGED)
    link.set_profile(1.0, LinkProfile())
    link.set_dark(2.0, None)
    link.send(2.0, packet(1), 100)
    assert link.pop_due(2.0) == [(2.0, packet(1))]


def test_store_of_packets_in_flight_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(model_module, "MAX_IN_FLIGHT_PACKETS", 3)
    link = make(delay_ms=1000)
    for number in range(5):
        link.send(0.0, packet(number), 100)
    assert link.in_flight_packets == 3
    assert link.drops[DropReason.IN_FLIGHT_FULL] == 2


def test_undeliverable_packet_is_counted_as_dropped() -> None:
    link = make()
    link.send(0.0, packet(0), 100)
    link.pop_due(0.0)
    link.count_undeliverable(100)
    assert (link.delivered_packets, link.delivered_bytes) == (0, 0)
    assert link.drops[DropReason.INTERFACE_DOWN] == 1


def test_loss_is_near_its_probability() -> None:
    link = make(loss=0.1)
    for number in range(20_000):
        link.send(0.0, packet(number), 100)
    # Binomial: the standard deviation is 0.0021, so six of them.
    assert link.drops[DropReason.LOSS] / 20_000 == pytest.approx(0.1, abs=0.0127)


def test_seed_alone_decides_the_fate_of_the_nth_packet() -> None:
    def survivors(seed: int, **first: float) -> list[int]:
        link = make(seed, **first)
        for number in range(50):
            link.send(0.0, packet(number), 100)
        link.pop_due(100.0)
        link.set_profile(100.0, LinkProfile(loss=0.5))
        for number in range(200):
            link.send(100.0, packet(number), 100)
        return numbers(link.pop_due(200.0))

    assert survivors(7) == survivors(7)
    assert survivors(7) == survivors(7, loss=0.3, jitter_ms=50, rate_kbps=1000)
    assert survivors(7) != survivors(8)


profiles = st.builds(
    LinkProfile,
    delay_ms=st.floats(0, 500),
    jitter_ms=st.floats(0, 200),
    loss=st.sampled_from([0.0, 0.1, 1.0]),
    rate_kbps=st.one_of(st.none(), st.just(0.0), st.floats(8, 100_000)),
    queue_bytes=st.integers(0, 20_000),
)
steps = st.one_of(
    st.tuples(st.just("send"), st.integers(1, 9000)),
    st.tuples(st.just("pop"), st.none()),
    st.tuples(st.just("profile"), profiles),
    st.tuples(st.just("dark"), st.sampled_from([None, DropReason.BLACKHOLE, DropReason.UNPLUGGED])),
)
scripts = st.lists(st.tuples(st.floats(0, 0.5), steps), max_size=60)


@given(first=profiles, script=scripts, seed=st.integers(0, 1000))
def test_whatever_happens_packets_are_accounted_for_and_stay_in_order(
    first: LinkProfile, script: list[tuple[float, tuple[str, object]]], seed: int
) -> None:
    link = LinkModel(first, Random(seed))
    now = 0.0
    sent_at: list[float] = []
    got: list[tuple[float, int, float]] = []  # departure, number, when popped

    def pop() -> None:
        got.extend((at, int.from_bytes(data, "big"), now) for at, data in link.pop_due(now))

    for pause, (action, argument) in script:
        now += pause
        if action == "send":
            assert isinstance(argument, int)
            link.send(now, packet(len(sent_at)), argument)
            sent_at.append(now)
        elif action == "profile":
            assert isinstance(argument, LinkProfile)
            link.set_profile(now, argument)
        elif action == "dark":
            assert argument is None or isinstance(argument, DropReason)
            link.set_dark(now, argument)
        else:
            pop()
        assert link.queue_bytes >= 0
    while (due := link.next_departure()) is not None:
        now = max(now, due) + EPSILON_S
        before = len(got)
        pop()
        assert len(got) > before, "next_departure promised a packet"

    order = [number for _, number, _ in got]
    assert order == sorted(set(order))
    assert [at for at, _, _ in got] == sorted(at for at, _, _ in got)
    assert all(at >= sent_at[number] - EPSILON_S and at <= popped for at, number, popped in got)
    assert link.sent_packets == len(sent_at)
    assert link.delivered_packets == len(got)
    stuck = link.sent_packets - link.delivered_packets - sum(link.drops.values())
    assert stuck >= 0
    if link.profile.rate_kbps != 0:
        assert (stuck, link.queue_bytes, link.in_flight_packets) == (0, 0, 0)


@given(
    rate_kbps=st.floats(8, 100_000),
    delay_ms=st.floats(0, 500),
    jitter_ms=st.floats(0, 100),
    queue_bytes=st.integers(1500, 50_000),
    sends=st.lists(st.tuples(st.floats(0, 0.05), st.integers(1, 1500)), min_size=1, max_size=80),
)
def test_constant_profile_is_kept_to(
    rate_kbps: float, delay_ms: float, jitter_ms: float, queue_bytes: int, sends: list[tuple[float, int]]
) -> None:
    link = make(rate_kbps=rate_kbps, delay_ms=delay_ms, jitter_ms=jitter_ms, queue_bytes=queue_bytes)
    now = 0.0
    for number, (pause, size) in enumerate(sends):
        now += pause
        link.send(now, packet(number), size)
        assert link.queue_bytes <= queue_bytes
    departures = []
    while (due := link.next_departure()) is not None:
        departures += link.pop_due(due + EPSILON_S)
    busy_until = 0.0
    sent_at = 0.0
    survivors = dict(zip(numbers(departures), (at for at, _ in departures), strict=True))
    for number, (pause, size) in enumerate(sends):
        sent_at += pause
        if number in survivors:
            busy_until = max(busy_until, sent_at) + size * 8 / (rate_kbps * 1000)
            # Not before it has been serialised and has propagated ...
            assert survivors[number] >= busy_until + delay_ms / 1000 - 1e-6
            # ... and with at most the jitter on top, its own or that of one ahead of it.
            assert survivors[number] <= busy_until + (delay_ms + jitter_ms) / 1000 + 1e-6
