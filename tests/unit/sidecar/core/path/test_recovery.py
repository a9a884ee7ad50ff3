from __future__ import annotations

import random
from typing import TYPE_CHECKING

import pytest

from plr.sidecar.core.path.received import MAX_ACK_DELAY_S, ReceivedPackets
from plr.sidecar.core.path.recovery import PTO_DATAGRAMS, Recovery
from plr.sidecar.core.path.reordering import PACKET_THRESHOLD
from plr.sidecar.core.wire import frame
from plr.sidecar.core.wire.frame import AckFrame
from tests.support.builders import message

if TYPE_CHECKING:
    from plr.sidecar.core.path.in_flight import Sent


def ack(*ranges: tuple[int, int], delay_s: float = 0.0) -> AckFrame:
    return AckFrame(ranges, delay_s)


def with_sent(count: int, *, at: float = 1.0, every_s: float = 0.0, first: int = 0) -> Recovery:
    recovery = Recovery(first)
    for index in range(count):
        recovery.on_finished_sent(recovery.take_numbers(), at + index * every_s, 100, (index,))
    return recovery


def numbers(gone: list[Sent] | None) -> list[int]:
    assert gone is not None
    return [number for run in gone for number in range(run.first, run.end)]


def test_acknowledged_datagrams_leave_the_flight() -> None:
    recovery = with_sent(5)
    assert recovery.in_flight == 500
    newly = recovery.on_ack(ack((3, 4), (0, 0)), 1.1)
    assert sorted(numbers(newly)) == [0, 3, 4]
    assert (recovery.in_flight, recovery.largest_acked) == (200, 4)
    assert recovery.rtt.latest == pytest.approx(0.1)


def test_repeating_an_acknowledgement_does_nothing() -> None:
    recovery = with_sent(5)
    recovery.on_ack(ack((0, 4)), 1.1)
    assert recovery.on_ack(ack((0, 4)), 5.0) == []
    assert recovery.rtt.latest == pytest.approx(0.1)
    assert recovery.in_flight == 0


def test_acknowledging_the_unsent_is_refused_whole() -> None:
    recovery = with_sent(5)
    assert recovery.on_ack(ack((0, 5)), 1.1) is None
    assert recovery.in_flight == 500


def test_numbers_from_before_the_path_and_giant_ranges_are_cheap() -> None:
    recovery = with_sent(2, first=2**40)
    newly = recovery.on_ack(ack((2**40, 2**40 + 1), (0, 2**40 - 2)), 1.1)  # would never end if walked through
    assert len(numbers(newly)) == 2


def test_lost_by_packet_threshold() -> None:
    recovery = with_sent(5)
    recovery.on_ack(ack((PACKET_THRESHOLD, PACKET_THRESHOLD)), 1.0001)
    assert numbers(recovery.detect_lost(1.0001)) == [0]
    assert recovery.in_flight == 300
    assert recovery.total_lost == 1


def test_lost_by_time_threshold_and_not_earlier() -> None:
    recovery = with_sent(2)
    recovery.on_ack(ack((1, 1)), 1.1)
    assert recovery.detect_lost(1.1) == []
    timer = recovery.loss_timer
    assert timer == pytest.approx(1.0 + 9 / 8 * 0.1)
    assert timer is not None
    assert recovery.detect_lost(timer - 1e-6) == []
    assert numbers(recovery.detect_lost(timer)) == [0]
    assert recovery.loss_timer is None


def test_what_was_sent_after_the_acknowledged_is_not_lost() -> None:
    recovery = with_sent(3)
    recovery.on_ack(ack((0, 0)), 1.1)
    assert recovery.detect_lost(99.0) == []
    assert recovery.loss_timer is None


def test_probe_timeout_doubles_gives_up_the_oldest_and_ends_with_an_acknowledgement() -> None:
    recovery = with_sent(12)
    recovery.rtt.sample(0.1, 0.0)
    timeout = 0.1 + 4 * 0.05 + MAX_ACK_DELAY_S
    assert 2 * timeout < recovery.rtt.longest_wait() < 4 * timeout
    assert recovery.pto_timer == pytest.approx(1.0 + timeout)
    assert numbers(recovery.on_probe_timeout(2.0)) == list(range(PTO_DATAGRAMS))
    assert recovery.pto_timer == pytest.approx(2.0 + 2 * timeout)
    recovery.on_probe_timeout(3.0)
    assert recovery.pto_timer == pytest.approx(3.0 + recovery.rtt.longest_wait())
    recovery.on_ack(ack((5, 5)), 1.2)
    assert recovery.pto_timer == pytest.approx(3.0 + recovery.rtt.probe_timeout(MAX_ACK_DELAY_S))


def test_probe_timeouts_stop_doubling_and_end_with_the_flight() -> None:
    recovery = with_sent(40)
    recovery.rtt.sample(0.1, 0.0)
    for turn in range(20):
        assert recovery.pto_timer is not None
        assert recovery.pto_timer - recovery.last_eliciting_at <= recovery.rtt.longest_wait() + 1e-9
        recovery.on_probe_timeout(float(turn + 2))
    assert recovery.pto_timer is None
    assert recovery.in_flight == 0


def test_when_the_path_answers_again_the_probe_timeout_is_now() -> None:
    recovery = with_sent(40)
    recovery.rtt.sample(0.1, 0.0)
    for turn in range(3):
        recovery.on_probe_timeout(float(turn + 2))
    recovery.ask_at_once(5.0)
    assert recovery.pto_timer is not None
    assert 4.0 < recovery.pto_timer <= 5.0 + 1e-9
    recovery.on_probe_timeout(5.0)
    assert recovery.pto_timer == pytest.approx(5.0 + 2 * recovery.rtt.probe_timeout(MAX_ACK_DELAY_S))


def test_giving_up_leaves_nothing_in_flight() -> None:
    recovery = with_sent(7)
    assert numbers(recovery.give_up_all(forget=False)) == list(range(7))
    assert (recovery.in_flight, recovery.total_lost, recovery.pto_timer) == (0, 7, None)


@pytest.mark.parametrize("seed", range(40))
def test_sender_and_receiver_agree_whatever_the_network_does(seed: int) -> None:
    """ReceivedPackets, the ACK codec and Recovery together, over a net that loses, doubles and reorders both ways."""
    rng = random.Random(seed)
    loss, doubling = rng.uniform(0, 0.4), rng.uniform(0, 0.3)
    recovery, packets = Recovery(first_number=rng.choice([0, 2**40])), ReceivedPackets()
    now = 1.0
    to_receiver: list[tuple[float, int]] = []
    to_sender: list[tuple[float, bytes]] = []
    arrived: set[int] = set()
    fate: dict[int, str] = {}
    carried = message(size=0)
    size_of: dict[int, int] = {}

    def settle(what: str, gone: list[Sent]) -> None:
        for run in gone:
            assert run.message is carried
            for number, index in zip(range(run.first, run.end), run.indices, strict=True):
                assert number not in fate, "acknowledged or lost twice"
                assert index == symbol_of[number]
                fate[number] = what

    symbol_of: dict[int, int] = {}
    sent: list[int] = []
    while len(sent) < 600 or recovery.sent:
        now += rng.choice([0.0001, 0.001, 0.02])
        if len(sent) < 600 and rng.random() < 0.7:
            count = rng.choice([1, 1, 2, 5, 40])
            first, index = recovery.take_numbers(count), rng.randrange(1000)
            run = range(first, first + count)
            if rng.random() < 0.8:
                sent += run
                symbol_of.update(zip(run, range(index, index + count), strict=True))
                size_of.update((number, 100) for number in run)
                size_of[run[-1]] = rng.choice([100, 60])
                recovery.on_run_sent(first, count, now, 100, size_of[run[-1]], carried, index)
            for number in run:
                for _ in range(2 if rng.random() < doubling else 1):
                    arrives_at = now + rng.choice([0.01, 0.011, 0.05])
                    to_receiver += [(arrives_at, number)] if rng.random() >= loss else []
        for due in [due for due in to_receiver if due[0] <= now]:
            to_receiver.remove(due)
            new = packets.add(due[1], now)
            assert not (new and due[1] in arrived), "taken twice"
            arrived |= {due[1]} if new else set()
            packets.owe_ack(now)
        if packets.ack_at is not None and packets.ack_at <= now:
            encoded = frame.encode_ack(*packets.take_ack(now))
            if rng.random() >= loss:
                to_sender.append((now + rng.choice([0.01, 0.04]), encoded))
        for due_ack in [due_ack for due_ack in to_sender if due_ack[0] <= now]:
            to_sender.remove(due_ack)
            (decoded,) = frame.decode_frames(memoryview(due_ack[1]))
            assert isinstance(decoded, AckFrame)
            newly = recovery.on_ack(decoded, now)
            assert newly is not None, "an honest receiver acknowledges nothing unsent"
            assert set(numbers(newly)) <= arrived, "acknowledged without having come"
            late = numbers(recovery.late(decoded, now))
            assert {fate[number] for number in late} <= {"lost"}, "late is what was lost before"
            assert set(late) <= arrived
            settle("acked", newly)
            settle("lost", recovery.detect_lost(now))
        if recovery.loss_timer is not None:
            if recovery.loss_timer <= now:
                settle("lost", recovery.detect_lost(now))
        elif recovery.pto_timer is not None and recovery.pto_timer <= now:
            settle("lost", recovery.on_probe_timeout(now))
        assert recovery.in_flight == sum(size_of[number] for number in numbers(recovery.sent))
        assert numbers(recovery.sent) == sorted(numbers(recovery.sent))
    assert recovery.in_flight == 0
    assert sorted(fate) == sent, "some datagram is neither acknowledged nor lost"
    assert recovery.total_lost == sum(what == "lost" for what in fate.values())
    assert recovery.loss_timer is None or recovery.detect_lost(now) == []
    assert recovery.pto_timer is None
