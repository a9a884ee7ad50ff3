from __future__ import annotations

from typing import TYPE_CHECKING

from plr.sidecar.core.base.values import PathState, Priority, RequestId
from plr.sidecar.core.message.reassembly import MAX_PEER_BYTES
from plr.sidecar.core.message.repair import MAX_DOUBLED_SYMBOLS
from plr.sidecar.core.seam.links import FragmentsLost, LinkCommand, Resend, Send, SendAbandon
from plr.sidecar.core.seam.stats import EngineStats
from plr.sidecar.core.transfer.outbox import MAX_GENERATIONS, Outbox
from plr.sidecar.core.transfer.room import LARGE_ROOM_BYTES, MAX_UNDELIVERED_MESSAGES, SMALL_BYTES, SMALL_ROOM_BYTES
from plr.sidecar.core.transfer.routes import Routes
from plr.sidecar.core.wire.frame import BASE_BYTES
from plr.sidecar.core.wire.messages import Encoded
from tests.support.builders import WLAN, WWAN, A, B, path

if TYPE_CHECKING:
    from plr.sidecar.core.base.slices import Step
    from plr.sidecar.core.base.values import PathId
    from plr.sidecar.core.message.outbound import OutboundMessage

SMALL = Encoded(b"", b"x")
OVER_WLAN, OVER_WWAN, TO_B = path(WLAN), path(WWAN), path(WLAN, B)


class Box:
    """An outbox whose commands the test reads."""

    def __init__(self, *up: PathId) -> None:
        self.routes = Routes()
        for up_path in up:
            self.routes.set_state(up_path, PathState.UP)
        self.commands: list[LinkCommand] = []
        self.stats = EngineStats()
        self.outbox = Outbox(self.routes, self.commands.append, self.stats)

    def come_up(self, path: PathId) -> None:
        self.routes.set_state(path, PathState.UP)
        self.do(self.outbox.on_path_up(path))

    def do(self, steps: list[Step], now: float = 0.0) -> None:
        for step in steps:
            step(now)

    def send(self, over: PathId = OVER_WLAN, size: int = 3000, expires: float = 10.0) -> OutboundMessage:
        message = self.outbox.send(
            over, Encoded(b"", bytes(size)), priority=Priority.NORMAL, deadline=1.0, expires=expires
        )
        assert self.commands.pop() == Send(over, message.symbols)
        return message

    def lost(self, message: OutboundMessage, *indices: int, over: PathId = OVER_WLAN, timed_out: bool = False) -> None:
        self.outbox.on_lost(FragmentsLost(over, message.symbols, indices, timed_out), 1.0)


def test_numbers_are_never_reused_and_finished_messages_go() -> None:
    box = Box(OVER_WLAN)
    numbers = []
    for _ in range(3):
        message = box.send()
        numbers.append(message.number)
        assert box.outbox.on_finished(A, message.number) is message
        assert message.over
        assert box.outbox.on_finished(A, message.number) is None
    assert len(set(numbers)) == 3
    assert (len(box.outbox), box.outbox.held_bytes) == (0, 0)


def test_a_peer_cannot_finish_the_messages_of_another() -> None:
    box = Box(OVER_WLAN)
    message = box.send()
    assert box.outbox.on_finished(B, message.number) is None
    assert not message.over


def test_lost_symbols_travel_again_but_not_those_that_arrived() -> None:
    box = Box(OVER_WLAN, OVER_WWAN)
    message = box.send()
    message.symbols.acked[1] = 1
    box.lost(message, 0, 1)
    assert box.commands == [Resend(OVER_WLAN, message.symbols, (0,))]
    box.lost(message, 1)
    assert len(box.commands) == 1


def test_after_a_timeout_the_other_path_is_taken_and_the_same_one_only_for_want_of_it() -> None:
    box = Box(OVER_WLAN, OVER_WWAN)
    message = box.send()
    box.lost(message, 0, timed_out=True)
    assert box.commands.pop() == Resend(OVER_WWAN, message.symbols, (0,))
    box.routes.set_state(OVER_WWAN, PathState.DOWN)
    box.lost(message, 0, timed_out=True)
    assert box.commands.pop() == Resend(OVER_WLAN, message.symbols, (0,))


def lossy(box: Box, *paths: PathId) -> None:
    for each in paths:
        box.routes.set_rtt(each, 0.05)
        box.routes.note_fates(each, 980, 20)


def test_symbols_sent_again_over_a_lossy_path_travel_twice_and_again_only_when_both_are_lost() -> None:
    box = Box(OVER_WLAN)
    message = box.send()
    lossy(box, OVER_WLAN)
    box.lost(message, 0, 1)
    twice = [Resend(OVER_WLAN, message.symbols, (0, 1))] * 2
    assert box.commands == twice
    box.lost(message, 0, 1)
    assert box.commands == twice
    message.symbols.acked[1] = 1
    box.lost(message, 0, 1)
    assert box.commands[2:] == [Resend(OVER_WLAN, message.symbols, (0,))] * 2


def test_the_copy_takes_another_path_when_it_is_as_good() -> None:
    box = Box(OVER_WLAN, OVER_WWAN)
    message = box.send()
    lossy(box, OVER_WLAN, OVER_WWAN)
    box.lost(message, 0)
    assert [command.path for command in box.commands if isinstance(command, Resend)] == [OVER_WLAN, OVER_WWAN]
    assert message.interfaces == {WLAN, WWAN}
    box.routes.set_rtt(OVER_WWAN, 0.11)
    box.lost(message, 1)
    assert box.commands[2:] == [Resend(OVER_WLAN, message.symbols, (1,))] * 2


def test_the_last_symbol_travels_twice_over_a_lossy_path_unless_repair_symbols_cover_it() -> None:
    box = Box(OVER_WLAN)
    lossy(box, OVER_WLAN)
    for fec, doubled in ((0.0, True), (None, False), (0.1, False)):
        box.commands.clear()
        content = Encoded(b"", bytes(5000))
        message = box.outbox.send(OVER_WLAN, content, priority=Priority.NORMAL, deadline=1.0, expires=9.0, fec=fec)
        assert message is not None
        expected = [Send(OVER_WLAN, message.symbols), Resend(OVER_WLAN, message.symbols, (message.symbols.count - 1,))]
        assert box.commands == expected[: 1 + doubled]


def test_many_symbols_lost_at_once_travel_once() -> None:
    box = Box(OVER_WLAN)
    message = box.send(size=100_000)
    lossy(box, OVER_WLAN)
    box.lost(message, *range(MAX_DOUBLED_SYMBOLS + 1))
    assert box.commands == [Resend(OVER_WLAN, message.symbols, tuple(range(MAX_DOUBLED_SYMBOLS + 1)))]


def test_copies_do_not_hold_back_what_an_interface_took_with_it() -> None:
    box = Box(OVER_WLAN, OVER_WWAN)
    message = box.send()
    lossy(box, OVER_WLAN)
    box.routes.set_rtt(OVER_WWAN, 1.0)
    box.lost(message, 0)
    box.commands.clear()
    box.routes.set_state(OVER_WLAN, PathState.DOWN)
    box.do(box.outbox.on_interface_gone(WLAN), 1.0)
    assert box.commands == [Resend(OVER_WWAN, message.symbols, (0, 1, 2))]


def test_copies_do_not_hold_back_what_waited_for_a_path() -> None:
    box = Box(OVER_WLAN)
    message = box.send()
    lossy(box, OVER_WLAN)
    box.lost(message, 0)
    box.routes.set_state(OVER_WLAN, PathState.DOWN)
    box.lost(message, 0, 1)
    box.commands.clear()
    box.come_up(OVER_WWAN)
    assert box.commands == [Resend(OVER_WWAN, message.symbols, (0, 1, 2))]


def test_without_a_path_messages_wait_and_all_missing_symbols_leave_with_the_first_one_up() -> None:
    box = Box()
    message, delivered, called_off = box.send(), box.send(), box.send()
    for parked in (message, delivered, called_off):
        box.lost(parked, 0)
        box.lost(parked, 2)
    assert not box.commands
    message.symbols.acked[1] = 1
    box.outbox.on_finished(A, delivered.number)
    box.outbox.drop(called_off)
    box.come_up(TO_B)
    assert not box.commands
    box.come_up(OVER_WWAN)
    assert box.commands == [Resend(OVER_WWAN, message.symbols, (0, 2))]
    box.come_up(OVER_WLAN)
    assert len(box.commands) == 1, "they wait no more"


def test_expired_messages_are_dropped_and_counted_also_when_they_wait() -> None:
    box = Box()
    message, longer = box.send(expires=5.0), box.send(expires=6.0)
    box.lost(message, 0)
    box.do(box.outbox.expired(5.0), 5.0)
    assert message.over
    assert not longer.over
    assert box.stats.dropped["message_expired"] == 1
    box.come_up(OVER_WLAN)
    assert not box.commands


def test_losses_of_a_message_past_its_time_end_it() -> None:
    box = Box(OVER_WLAN)
    message = box.send(expires=0.5)
    box.lost(message, 0)
    assert message.over
    assert not box.commands
    assert len(box.outbox) == 0


def test_the_answers_to_a_request_are_dropped_together_and_nothing_else() -> None:
    box = Box(OVER_WLAN, OVER_WWAN, TO_B)
    asked, other = RequestId(bytes(16)), RequestId(bytes(15) + b"x")

    def answer(over: PathId, request: RequestId) -> OutboundMessage:
        message = box.outbox.send(over, SMALL, priority=Priority.NORMAL, deadline=1.0, expires=10.0, answers=request)
        assert message is not None
        return message

    dropped = [answer(OVER_WLAN, asked), answer(OVER_WWAN, asked)]
    stay = [answer(OVER_WLAN, other), answer(TO_B, asked), box.send(OVER_WLAN)]
    delivered = answer(OVER_WLAN, asked)
    box.outbox.on_finished(A, delivered.number)
    for _ in range(2):
        box.outbox.drop_answers(A, asked)
    assert [message.over for message in (*dropped, *stay)] == [True, True, False, False, False]
    for message in stay:
        box.outbox.drop(message)
    assert not box.outbox._answers


def test_dropping_a_peer_ends_its_messages_and_nobody_elses() -> None:
    box = Box(OVER_WLAN, TO_B)
    gone, stays = box.send(OVER_WLAN), box.send(TO_B)
    box.do(box.outbox.drop_peer(A))
    assert gone.over
    assert not stays.over
    assert box.outbox.held_bytes == 3000


def test_an_interface_that_goes_leaves_none_of_its_messages_behind() -> None:
    box = Box(OVER_WLAN, OVER_WWAN)
    only_there, partly_there, elsewhere = box.send(OVER_WLAN), box.send(OVER_WLAN), box.send(OVER_WWAN)
    box.lost(partly_there, 0, timed_out=True)  # its other symbols are still queued on wlan0
    box.commands.clear()
    box.routes.forget_interface(WLAN)
    box.do(box.outbox.on_interface_gone(WLAN), 1.0)
    assert box.commands == [
        Resend(OVER_WWAN, only_there.symbols, (0, 1, 2)),
        Resend(OVER_WWAN, partly_there.symbols, (0, 1, 2)),
    ]
    assert not elsewhere.over


def test_what_moved_to_another_interface_is_not_left_behind_there_either() -> None:
    box = Box(OVER_WLAN, OVER_WWAN)
    message = box.send(OVER_WLAN)
    box.lost(message, 0, timed_out=True)
    assert box.commands.pop() == Resend(OVER_WWAN, message.symbols, (0,))
    box.routes.forget_interface(WWAN)
    box.do(box.outbox.on_interface_gone(WWAN), 1.0)
    assert box.commands == [Resend(OVER_WLAN, message.symbols, (0, 1, 2))]


def test_the_box_is_capped_and_a_greedy_peer_does_not_lock_others_out() -> None:
    box = Box(OVER_WLAN, TO_B)
    taken = 0
    while box.outbox.admits(A, SMALL.size):
        box.outbox.send(OVER_WLAN, SMALL, priority=Priority.NORMAL, deadline=1.0, expires=10.0)
        taken += 1
    assert taken == MAX_UNDELIVERED_MESSAGES // 2
    assert box.stats.dropped["outbox_full"] == 1
    assert box.outbox.has_room(B, 1000)


def test_one_peer_never_gets_more_bytes_than_it_can_reassemble() -> None:
    box = Box(OVER_WLAN, TO_B)
    assert SMALL_ROOM_BYTES + LARGE_ROOM_BYTES == MAX_PEER_BYTES
    for _ in range(3):
        box.send(size=LARGE_ROOM_BYTES // 3)
    assert not box.outbox.has_room(A, SMALL_BYTES + 1)
    assert box.outbox.has_room(B, LARGE_ROOM_BYTES // 3)
    for _ in range(SMALL_ROOM_BYTES // SMALL_BYTES):
        box.send(size=SMALL_BYTES)
    assert not box.outbox.has_room(A, BASE_BYTES)
    assert box.outbox.held_bytes == MAX_PEER_BYTES
    assert box.outbox.has_room(A, 1000), "what one datagram holds takes nothing there"


def carries(box: Box, over: PathId, size: int) -> None:
    box.routes.set_max_datagram(over, size)


def test_symbols_fit_every_path_to_that_peer_that_is_not_down() -> None:
    box = Box(OVER_WLAN, OVER_WWAN)
    carries(box, OVER_WLAN, 8952)
    carries(box, OVER_WWAN, 1372)
    box.routes.set_state(TO_B, PathState.UP)
    assert box.send().symbols.datagram_bytes == 1372
    assert box.send(TO_B).symbols.datagram_bytes == BASE_BYTES
    box.routes.set_state(OVER_WWAN, PathState.DOWN)
    assert box.send(size=10_000).symbols.datagram_bytes == 8952
    assert box.send(size=10).symbols.datagram_bytes < 100


def test_lost_symbols_take_the_path_that_carries_them() -> None:
    box = Box(OVER_WLAN)
    carries(box, OVER_WLAN, 1472)
    message = box.send()
    box.routes.set_state(OVER_WWAN, PathState.UP)
    box.routes.set_rtt(OVER_WLAN, 1.0)
    box.lost(message, 0)
    box.lost(message, 1, timed_out=True)
    assert box.commands == [Resend(OVER_WLAN, message.symbols, (0,)), Resend(OVER_WLAN, message.symbols, (1,))]


def test_a_message_that_no_path_carries_any_more_is_cut_again() -> None:
    box = Box(OVER_WLAN)
    carries(box, OVER_WLAN, 1472)
    message = box.send(size=3000)
    message.symbols.acked[0] = 1
    box.routes.set_state(OVER_WWAN, PathState.UP)
    box.routes.set_state(OVER_WLAN, PathState.DOWN)
    box.lost(message, 1)
    (command,) = box.commands
    recut = message.newest
    assert command == Send(OVER_WWAN, recut.symbols)
    assert message.over
    assert recut.number > message.number
    assert recut.symbols.datagram_bytes == BASE_BYTES
    assert len(recut.symbols.missing()) == recut.symbols.count
    assert b"".join(recut.symbols.symbol_data(index) for index in range(recut.symbols.count)) == bytes(3000)
    assert (len(box.outbox), box.outbox.held_bytes) == (1, 3000)
    # Who still holds the first one means the bytes.
    box.lost(message, 2)
    box.outbox.drop(message)
    assert recut.over
    assert (len(box.outbox), box.outbox.held_bytes) == (0, 0)
    assert box.commands[1:] == [SendAbandon(OVER_WWAN, recut.number)]


def test_what_waits_for_a_path_is_cut_to_the_one_that_comes() -> None:
    box = Box(OVER_WLAN)
    carries(box, OVER_WLAN, 1472)
    message = box.send()
    box.routes.set_state(OVER_WLAN, PathState.DOWN)
    box.lost(message, 0)
    assert not box.commands
    box.routes.set_state(OVER_WLAN, PathState.UP)
    box.come_up(OVER_WLAN)
    assert box.commands == [Send(OVER_WLAN, message.newest.symbols)]
    assert message.newest.symbols.datagram_bytes == BASE_BYTES


def test_a_suspect_path_is_left_for_one_that_is_too_small() -> None:
    box = Box(OVER_WLAN, OVER_WWAN)
    carries(box, OVER_WLAN, 1472)
    box.routes.set_state(OVER_WWAN, PathState.DOWN)
    message = box.send()
    box.routes.set_state(OVER_WWAN, PathState.UP)
    box.routes.set_state(OVER_WLAN, PathState.UNSTABLE)
    box.lost(message, 0, timed_out=True)
    assert box.commands == [Send(OVER_WWAN, message.newest.symbols)]


def test_a_peer_that_has_part_of_a_dropped_message_is_told() -> None:
    box = Box(OVER_WLAN)
    message = box.send(size=3000)
    message.symbols.symbol_data(0)
    box.outbox.drop(message)
    box.outbox.drop(message)
    assert box.commands == [SendAbandon(OVER_WLAN, message.number)]


def test_nothing_is_said_of_messages_that_did_not_leave_or_that_one_datagram_holds_or_that_arrived() -> None:
    box = Box(OVER_WLAN)
    unsent, small, finished, answered = (box.send(size=size) for size in (3000, 100, 3000, 3000))
    for begun in (small, finished, answered):
        begun.symbols.symbol_data(0)
    box.outbox.drop(unsent)
    box.outbox.drop(small)
    box.outbox.on_finished(A, finished.number)
    box.outbox.on_answered(answered)
    assert box.commands == []
    assert len(box.outbox) == 0


def test_a_forgotten_message_is_sent_again_but_not_for_ever() -> None:
    box = Box(OVER_WLAN)
    first = message = box.send(size=3000)
    message.symbols.acked[0] = message.symbols.acked[1] = 1
    for _ in range(MAX_GENERATIONS):
        box.outbox.on_forgotten(B, message.number)  # not his
        box.outbox.on_forgotten(A, message.number)
        assert message.over
        message = first.newest
        assert box.commands.pop() == Send(OVER_WLAN, message.symbols)
        assert len(message.symbols.missing()) == message.symbols.count
        assert (len(box.outbox), box.outbox.held_bytes) == (1, 3000)
    box.outbox.on_forgotten(A, message.number)
    assert (len(box.outbox), box.outbox.held_bytes, box.commands) == (0, 0, [])
    assert box.stats.dropped["message_forgotten"] == MAX_GENERATIONS + 1


def share(box: Box, *others: PathId, size: int = 30_000) -> OutboundMessage:
    """Over wlan0 and these."""
    message = box.outbox.send(
        OVER_WLAN,
        Encoded(b"", bytes(size)),
        priority=Priority.NORMAL,
        deadline=1.0,
        expires=10.0,
        shared_by=others,
        repeats=1.0,
    )
    assert box.commands == [Send(each, message.symbols) for each in (OVER_WLAN, *others)]
    box.commands.clear()
    return message


def untaken(message: OutboundMessage) -> int:
    assert message.symbols.sharing is not None
    return message.symbols.sharing.untaken


def all_taken(message: OutboundMessage) -> None:
    assert message.symbols.sharing is not None
    message.symbols.sharing.take_all()


def test_what_one_path_lost_of_a_shared_message_may_leave_by_each_that_is_up() -> None:
    box = Box(OVER_WLAN, OVER_WWAN)
    message = share(box, OVER_WWAN)
    all_taken(message)
    box.lost(message, 1, 2)
    assert box.commands == [Resend(each, message.symbols, ()) for each in (OVER_WLAN, OVER_WWAN)]
    assert untaken(message) == 2
    box.commands.clear()
    box.routes.set_state(OVER_WLAN, PathState.UNSTABLE)
    box.lost(message, 3)
    assert box.commands == [Resend(OVER_WWAN, message.symbols, ())]


def test_lost_symbols_of_a_shared_message_leave_by_a_path_that_is_not_up_only_for_want_of_one() -> None:
    box = Box(OVER_WLAN, OVER_WWAN)
    message = share(box, OVER_WWAN)
    for each in (OVER_WLAN, OVER_WWAN):
        box.routes.set_state(each, PathState.UNSTABLE)
    box.lost(message, 3, timed_out=True)
    assert box.commands == [Resend(OVER_WWAN, message.symbols, (3,))]
    assert untaken(message) == message.symbols.count, "for the first that is up again"


def test_a_shared_message_goes_over_another_path_when_none_of_its_own_is_left() -> None:
    third = path("wwan1")
    box = Box(OVER_WLAN, OVER_WWAN, third)
    message = share(box, OVER_WWAN)
    for each in (OVER_WLAN, OVER_WWAN):
        box.routes.set_state(each, PathState.DOWN)
    box.lost(message, over=OVER_WWAN)
    assert box.commands == [Resend(third, message.symbols, tuple(range(message.symbols.count)))]
    assert untaken(message) == 0


def test_a_shared_message_that_waited_for_a_path_leaves_by_the_one_that_comes() -> None:
    box = Box(OVER_WLAN, OVER_WWAN)
    message = share(box, OVER_WWAN)
    for each in (OVER_WLAN, OVER_WWAN):
        box.routes.set_state(each, PathState.DOWN)
    box.lost(message)
    assert box.commands == []
    box.come_up(OVER_WWAN)
    assert box.commands == [Resend(OVER_WWAN, message.symbols, ())]
    assert untaken(message) == message.symbols.count


def test_a_shared_message_that_is_cut_again_is_still_shared() -> None:
    box = Box(OVER_WLAN, OVER_WWAN)
    for each in (OVER_WLAN, OVER_WWAN):
        box.routes.set_max_datagram(each, 1400)
    message = share(box, OVER_WWAN)
    for each in (OVER_WLAN, OVER_WWAN):
        box.routes.set_max_datagram(each, BASE_BYTES)
    box.lost(message)
    again = message.newest
    assert again is not message
    sent = [command for command in box.commands if isinstance(command, Send)]
    assert {command.path for command in sent} == {OVER_WLAN, OVER_WWAN}
    assert all(command.message is again.symbols for command in sent)


def test_a_path_that_comes_back_shares_again_what_it_shared() -> None:
    box = Box(OVER_WLAN, OVER_WWAN)
    message, other = share(box, OVER_WWAN), box.send()
    box.routes.set_state(OVER_WLAN, PathState.DOWN)
    box.come_up(OVER_WLAN)
    assert box.commands == [Resend(OVER_WLAN, message.symbols, ())]
    all_taken(message)
    box.commands.clear()
    box.come_up(OVER_WLAN)
    assert box.commands == [], "nothing is left of it"
    assert not other.over


def test_an_interface_that_came_back_and_goes_again_leaves_nothing_of_a_shared_message_behind() -> None:
    box = Box(OVER_WLAN, OVER_WWAN)
    message = share(box, OVER_WWAN)
    box.routes.forget_interface(WLAN)
    box.do(box.outbox.on_interface_gone(WLAN))
    box.come_up(OVER_WLAN)
    box.lost(message, 1)
    assert WLAN in message.interfaces
    all_taken(message)
    box.routes.forget_interface(WLAN)
    box.do(box.outbox.on_interface_gone(WLAN))
    assert untaken(message) == message.symbols.count
