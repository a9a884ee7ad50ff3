"""Messages over one path: their datagrams, what is acknowledged, what is lost, what is owed."""

from __future__ import annotations

import pytest

from plr.sidecar.core.message.symbols import MessageSymbols
from plr.sidecar.core.path.received import MAX_ACK_DELAY_S
from plr.sidecar.core.seam.links import (
    FinishedLost,
    FragmentsLost,
    FragmentsReceived,
    MessageFinished,
    Send,
    SendFinished,
    SetCarrier,
)
from plr.sidecar.core.wire import frame
from plr.sidecar.core.wire.frame import AckFrame, Finished, Fragment
from plr.sidecar.core.wire.messages import Encoded
from tests.support.builders import PEER_SESSION, A, message
from tests.unit.sidecar.core.link.test_link import (
    PATH,
    fragment,
    numbers,
    up,
)


def test_a_message_goes_out_in_numbered_datagrams_and_is_acknowledged() -> None:
    bench, outbound = up(), message(size=3000)
    bench.execute(Send(PATH, outbound))
    sent = bench.sent()
    assert [item.symbol_index for item in bench.frames(sent) if isinstance(item, Fragment)] == [0, 1, 2]
    first = numbers(sent)[0]
    assert numbers(sent) == [first, first + 1, first + 2]
    assert all(len(datagram) <= frame.BASE_BYTES for datagram in sent)
    bench.now += 0.01
    bench.receive(frame.encode_ack([(first, first + 2)], 0.0), frame.encode_finished(Finished(1)))
    assert bytes(outbound.acked) == b"\1\1\1"
    assert MessageFinished(A, 1) in bench.events()


def test_a_hole_in_the_acknowledgements_is_reported_lost() -> None:
    bench, outbound = up(), message(size=9000)
    bench.execute(Send(PATH, outbound))
    first = numbers(bench.sent())[0]
    bench.now += 0.01
    bench.receive(frame.encode_ack([(first + 3, first + 7), (first + 1, first + 1)], 0.0))
    lost = [event for event in bench.events() if isinstance(event, FragmentsLost)]
    assert [(event.indices, event.timed_out) for event in lost] == [((0, 2), False)]


def test_without_any_acknowledgement_the_oldest_are_reported_timed_out() -> None:
    bench, outbound = up(), message(size=9000)
    bench.execute(Send(PATH, outbound))
    bench.sent()
    bench.wait(0.059)
    lost = [event for event in bench.events() if isinstance(event, FragmentsLost)]
    assert lost[0].indices == (0, 1)
    assert lost[0].timed_out


def test_a_received_fragment_is_handed_up_and_acknowledged() -> None:
    bench = up()
    bench.receive(fragment())
    (event,) = bench.events()
    assert isinstance(event, FragmentsReceived)
    assert (event.path, event.session, [item.message for item in event.fragments]) == (PATH, PEER_SESSION, [1])
    assert bench.sent() == [], "the acknowledgement waits for company"
    (ack,) = bench.frames(bench.wait(MAX_ACK_DELAY_S))
    assert isinstance(ack, AckFrame)
    assert ack.ranges[0] == (bench.number - 1, bench.number)


def test_an_owed_finished_takes_the_acknowledgement_along_and_is_repeated_until_acknowledged() -> None:
    bench = up()
    bench.receive(fragment())
    bench.execute(SendFinished(PATH, 1))
    (datagram,) = bench.sent()
    assert [type(item) for item in bench.frames([datagram])] == [Finished, AckFrame]
    again = [item for item in bench.frames(bench.wait(0.2)) if isinstance(item, Finished)]
    assert again == [Finished(1)] * len(again)
    assert again
    bench.receive(frame.encode_ack([(0, numbers([datagram])[0] + 20)], 0.0))


def test_many_finished_travel_together_and_are_all_repeated_when_lost() -> None:
    bench = up()
    for number in range(100):
        bench.execute(SendFinished(PATH, number))
    told = [[item.message for item in bench.frames([one]) if isinstance(item, Finished)] for one in bench.sent()]
    assert [number for one in told for number in one] == list(range(100))
    assert len(told) == 2
    again = {item.message for item in bench.frames(bench.wait(0.4)) if isinstance(item, Finished)}
    assert again == set(range(100))


def test_a_finished_whose_path_dies_is_handed_back() -> None:
    bench = up()
    bench.execute(SendFinished(PATH, 1))
    bench.sent()
    bench.execute(SendFinished(PATH, 2))
    bench.execute(SetCarrier(on=False))
    bench.execute(SendFinished(PATH, 3))
    lost = [event for event in bench.events() if isinstance(event, FinishedLost)]
    assert sorted(number for event in lost for number in event.numbers) == [1, 2, 3]
    assert not [item for item in bench.frames(bench.sent()) if isinstance(item, Finished)]


def test_expired_messages_are_not_sent_and_counted() -> None:
    bench = up()
    bench.execute(Send(PATH, message(expires=bench.now - 1)))
    assert bench.sent() == []
    assert bench.link.stats.dropped["expired"] == 1


class EndedMeanwhile(MessageSymbols):
    """The engine ends it while its link cuts it."""

    __slots__ = ()

    def symbol_data(self, index: int) -> bytes | memoryview:
        data = super().symbol_data(index)
        self.over = True
        return data


@pytest.mark.audit("dp-7")
@pytest.mark.parametrize("size", [3000, 100])
def test_what_is_ended_while_it_is_cut_does_not_leave_and_what_is_owed_does(size: int) -> None:
    bench = up()
    bench.execute(SendFinished(PATH, 7))
    ended = EndedMeanwhile(1, Encoded(b"", bytes(size)), deadline=10.0, expires=20.0)
    bench.execute(Send(PATH, ended))
    assert [type(item) for item in bench.frames(bench.sent())] == [Finished]
    assert ended.begun
    bench.execute(Send(PATH, message(2, size=100)))
    assert [type(item) for item in bench.frames(bench.sent())] == [Fragment]
