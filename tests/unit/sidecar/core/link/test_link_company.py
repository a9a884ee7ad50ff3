"""Control frames wait for a datagram to travel in, where nobody waits for them."""

from __future__ import annotations

from plr.sidecar.core.link.link import MAX_FINISHED_DELAY_S
from plr.sidecar.core.seam.links import FragmentsLost, Send, SendFinished
from plr.sidecar.core.wire import frame
from plr.sidecar.core.wire.frame import BASE_SYMBOL_BYTES, AckFrame, Finished, Fragment
from tests.support.builders import message
from tests.unit.sidecar.core.link.test_link import PATH, fragment, numbers, up


def test_a_finished_that_may_wait_waits_for_a_moment_only() -> None:
    bench = up()
    bench.execute(SendFinished(PATH, 1, at_once=False))
    assert bench.sent() == []
    assert [type(item) for item in bench.frames(bench.wait(MAX_FINISHED_DELAY_S))] == [Finished]


def test_what_is_owed_travels_with_a_small_answer_and_both_are_repeated_when_lost() -> None:
    bench = up()
    bench.receive(fragment())
    bench.execute(SendFinished(PATH, 1, at_once=False))
    answer = message(7, 1000)
    bench.execute(Send(PATH, answer))
    bench.events()
    (datagram,) = bench.sent()
    assert [type(item) for item in bench.frames([datagram])] == [Finished, AckFrame, Fragment]
    assert [Finished(1)] == [item for item in bench.frames(bench.wait(0.2)) if isinstance(item, Finished)][:1]
    lost = [event for event in bench.events() if isinstance(event, FragmentsLost)]
    assert (lost[0].message, lost[0].indices) == (answer, (0,))


def test_one_acknowledgement_settles_an_answer_and_the_finished_beside_it() -> None:
    bench = up()
    bench.execute(SendFinished(PATH, 1, at_once=False))
    answer = message(7, 1000)
    bench.execute(Send(PATH, answer))
    (number,) = numbers(bench.sent())
    bench.receive(frame.encode_ack([(number, number)], 0.0))
    assert answer.acked[0]
    assert not [item for item in bench.frames(bench.wait(0.3)) if isinstance(item, Finished | Fragment)]


def test_what_is_owed_leaves_before_a_datagram_that_has_no_room_for_it() -> None:
    bench = up()
    bench.receive(fragment())
    bench.execute(SendFinished(PATH, 1, at_once=False))
    bench.execute(Send(PATH, message(7, BASE_SYMBOL_BYTES)))
    first, second = bench.sent()
    assert [type(item) for item in bench.frames([first])] == [Finished, AckFrame]
    assert [type(item) for item in bench.frames([second])] == [Fragment]


def test_no_datagram_has_more_frames_than_the_peer_reads() -> None:
    bench = up()
    for number in range(100):
        bench.execute(SendFinished(PATH, number, at_once=False))
    bench.execute(Send(PATH, message(7, 10)))
    assert [len(bench.frames([datagram])) for datagram in bench.sent()] == [64, 36, 1]
