"""Answers that wait for room at a cloud."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from plr.protos.model.ids import NodeName
from plr.sidecar.core.base.slices import SLICE, Backlog
from plr.sidecar.core.base.values import PathState, Priority, RejectReason
from plr.sidecar.core.cloud import answers as answers_module
from plr.sidecar.core.cloud.answers import Answers
from plr.sidecar.core.cloud.executions import Reply, ReplyTo
from plr.sidecar.core.rules.service_rule import Rules
from plr.sidecar.core.seam.links import LinkCommand, Send
from plr.sidecar.core.seam.stats import EngineStats
from plr.sidecar.core.transfer.outbox import Outbox
from plr.sidecar.core.transfer.room import SMALL_ROOM_BYTES
from plr.sidecar.core.transfer.routes import Routes
from plr.sidecar.core.wire.messages import RejectionMessage, ResponseMessage, decode_message
from tests.support.builders import ECHO, path, request_id, rule
from tests.unit.sidecar.core.request_table import RACE

if TYPE_CHECKING:
    from plr.sidecar.core.base.values import PathId
    from plr.sidecar.core.message.symbols import MessageSymbols
    from plr.sidecar.core.wire.messages import Message

pytestmark = pytest.mark.audit("dp-1")
ROBOT = NodeName("robot")
WLAN, WWAN = path("eth0", ROBOT, 0), path("eth0", ROBOT, 1)
LARGE = 16_000_000


class Cloud:
    """Answers and an outbox, and what left of it."""

    def __init__(self) -> None:
        self.routes, self.stats = Routes(), EngineStats()
        self.backlog = Backlog()
        self.commands: list[LinkCommand] = []
        self.outbox = Outbox(self.routes, self.commands.append, self.stats)
        self.answers = Answers(Rules((rule(),)), self.routes, self.outbox, self.stats, self.backlog)
        for each in (WLAN, WWAN):
            self.routes.set_state(each, PathState.UP)

    def answer(
        self, number: int, size: int, *ways: PathId, now: float = 0.0, first_copy: int = 0, expires: float = 10.0
    ) -> None:
        replies = [
            Reply(
                ReplyTo(way, copy),
                ECHO,
                ResponseMessage(request_id(number), copy, 0.01, bytes(size)),
                Priority.NORMAL,
                5.0,
                expires,
            )
            for copy, way in enumerate(ways or (WLAN,), first_copy)
        ]
        self.answers.send(replies, now)

    def sent(self) -> list[tuple[int, int, PathId]]:
        """(request, copy, path) of what was sent since the last look."""
        found = [(decoded(command.message), command.path) for command in self.commands if isinstance(command, Send)]
        self.commands.clear()
        return [(number_of(message), copy_of(message), way) for message, way in found]

    def finish(self, number: int, copy: int = 0) -> None:
        """The robot got this, and what comes of it."""
        for message in list(self.outbox._messages.values()):
            content = decoded(message.symbols)
            if number_of(content) == number and copy_of(content) == copy:
                self.outbox.on_finished(ROBOT, message.number)
        self.answers.on_room(1.0)


def decoded(symbols: MessageSymbols) -> Message:
    return decode_message(memoryview(b"".join(symbols.content)))


def number_of(message: Message) -> int:
    assert isinstance(message, (ResponseMessage, RejectionMessage))
    return int.from_bytes(message.request_id, "big")


def copy_of(message: Message) -> int:
    assert isinstance(message, (ResponseMessage, RejectionMessage))
    return message.copy


def test_a_large_answer_goes_over_one_path_first_and_over_the_other_when_no_answer_waits() -> None:
    cloud = Cloud()
    for number in range(1, 5):
        cloud.answer(number, LARGE, WLAN, WWAN)
    assert cloud.sent() == [(1, 0, WLAN), (1, 1, WWAN), (2, 0, WLAN)]
    assert cloud.answers.unsent([ROBOT]) == 2
    cloud.finish(2)
    assert cloud.sent() == [(3, 0, WLAN)]
    cloud.finish(1)
    assert cloud.sent() == [(4, 0, WLAN)]
    assert cloud.answers.unsent([ROBOT]) == 0
    cloud.finish(1, copy=1)
    assert cloud.sent() == [(2, 1, WWAN)], "now the copies, as nothing waits for its first"
    for _ in range(3):
        for number in range(1, 5):
            for copy in (0, 1):
                cloud.finish(number, copy)
    assert len(cloud.answers) == len(cloud.outbox) == cloud.answers.held_bytes == 0


def test_small_answers_take_all_paths_at_once_and_large_ones_do_not_keep_them() -> None:
    cloud = Cloud()
    for number in range(1, 6):
        cloud.answer(number, LARGE)
    cloud.sent()
    cloud.answer(6, 100_000, WLAN, WWAN)
    cloud.answer(7, 10, WLAN, WWAN)
    assert cloud.sent() == [(6, 0, WLAN), (6, 1, WWAN), (7, 0, WLAN), (7, 1, WWAN)]


def test_many_small_ones_leave_the_large_one_its_room() -> None:
    cloud = Cloud()
    for number in range(1, 2 + SMALL_ROOM_BYTES // 200_000):
        cloud.answer(number, 200_000)
    assert cloud.answers.unsent([ROBOT]) > 0
    cloud.sent()
    cloud.answer(1000, LARGE)
    assert cloud.sent() == [(1000, 0, WLAN)]


def test_a_copy_that_asks_twice_gets_one_answer_also_when_the_kept_one_is_gone() -> None:
    cloud = Cloud()
    for number in range(1, 5):
        cloud.answer(number, LARGE)
    cloud.sent()
    for number in (1, 4):  # under way, waiting
        cloud.answer(number, LARGE)
        forgotten = RejectionMessage(request_id(number), 0, RejectReason.FORGOTTEN, "")
        cloud.answers.send([Reply(ReplyTo(WWAN, 0), ECHO, forgotten, Priority.NORMAL, 5.0, 10.0)], 0.0)
    assert cloud.sent() == []
    cloud.finish(1)
    assert cloud.sent() == [(4, 0, WLAN)]


def test_answers_that_only_further_copies_wait_for_go_before_one_that_nobody_has_got(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(answers_module, "MAX_ANSWER_BYTES", 8 * LARGE)
    cloud = Cloud()
    for number in range(1, 5):
        cloud.answer(number, LARGE, WLAN, WWAN)
    cloud.finish(2)
    cloud.answer(5, LARGE)
    assert cloud.stats.dropped["answer_copies_unsent"] == 1
    assert cloud.stats.dropped["answers_full"] == 0
    cloud.sent()
    cloud.answer(6, LARGE)
    assert cloud.stats.dropped["answers_full"] == 1
    (told,) = cloud.sent()
    assert told == (6, 0, WLAN)
    assert decoded(list(cloud.outbox._messages.values())[-1].symbols).reason is RejectReason.FORGOTTEN  # type: ignore[union-attr]


@pytest.mark.parametrize("begun", [True, False])
def test_what_has_not_begun_to_leave_is_given_up_before_its_time_is_over(begun: bool) -> None:
    cloud = Cloud()
    cloud.answer(1, LARGE, WLAN, WWAN)
    for message in cloud.outbox._messages.values():
        message.symbols.begun = begun
    assert cloud.answers.next_timer() == 9.0
    cloud.sent()
    cloud.answers.handle_timer(9.0)
    told = [] if begun else [(1, 0, WLAN), (1, 1, WWAN)]
    assert cloud.sent() == told
    cloud.answers.handle_timer(10.0)
    assert len(cloud.answers) == 0
    assert cloud.stats.dropped["answer_unsent"] == (not begun)


def test_a_rejection_does_not_stand_for_an_answer_that_comes_later() -> None:
    cloud = Cloud()
    refused = RejectionMessage(request_id(1), 0, RejectReason.OVERLOADED, "")
    for _ in range(2):
        cloud.answers.send([Reply(ReplyTo(WLAN, 0), ECHO, refused, Priority.NORMAL, 5.0, 10.0)], 0.0)
    cloud.answer(1, 10, WWAN, first_copy=1)
    assert cloud.sent() == [(1, 0, WLAN), (1, 1, WWAN)]
    cloud.answers.drop(ROBOT, request_id(1))
    assert len(cloud.answers) == len(cloud.outbox) == 0


@pytest.mark.audit("dp-10")
def test_a_turn_sends_no_more_than_a_slice_of_what_got_room() -> None:
    """A large answer ends and thousands of small ones fit in its place: each is as much work as any other."""
    cloud = Cloud()
    cloud.answer(0, SMALL_ROOM_BYTES // 70)
    for number in range(1, 70):
        cloud.answer(number, SMALL_ROOM_BYTES // 70)
    small = range(1000, 1150)
    for number in small:
        cloud.answer(number, 1300)
    assert len(cloud.sent()) < 70 + len(small)
    waiting = cloud.answers.unsent([ROBOT])
    assert waiting > 2 * SLICE
    cloud.backlog.begin_turn(1.0)
    for number in range(5):
        cloud.finish(number)
    assert len(cloud.sent()) == SLICE
    now = 1.0
    while cloud.backlog.next_timer() is not None:
        now += 0.001
        cloud.backlog.begin_turn(now)
        cloud.backlog.run(now)
        assert len(cloud.sent()) <= SLICE
    assert cloud.answers.unsent([ROBOT]) == 0


@pytest.mark.audit("dp-10")
def test_an_answer_that_has_room_waits_for_no_backlog() -> None:
    cloud = Cloud()
    cloud.backlog.add_steps([lambda _: None] * 100, 0.0)
    cloud.answer(1, 1300)
    assert cloud.sent() == [(1, 0, WLAN)]


def reply(number: int, copy: int, *ways: PathId, size: int = 30_000) -> Reply:
    response = ResponseMessage(request_id(number), copy, 0.01, bytes(size))
    return Reply(ReplyTo(ways[0], copy, ways[1:]), ECHO, response, Priority.NORMAL, 5.0, 10.0)


def test_the_paths_by_which_a_request_came_carry_its_answer_together() -> None:
    cloud = Cloud()
    cloud.answers.send([reply(1, 0, WWAN, WLAN)], 0.0)
    sends = [command for command in cloud.commands if isinstance(command, Send)]
    assert [command.path for command in sends] == [WWAN, WLAN]
    assert sends[0].message is sends[1].message
    assert sends[0].message.sharing is not None


@pytest.mark.parametrize(("state", "ways"), [(PathState.DOWN, [WLAN]), (PathState.UNSTABLE, [WLAN])])
def test_an_answer_leaves_out_the_paths_that_are_not_up_meanwhile(state: PathState, ways: list[PathId]) -> None:
    cloud = Cloud()
    cloud.routes.set_state(WWAN, state)
    cloud.answers.send([reply(1, 0, WWAN, WLAN)], 0.0)
    assert cloud.sent() == [(1, 0, way) for way in ways]


def test_the_answers_to_a_race_are_not_shared() -> None:
    cloud = Cloud()
    cloud.answers.send([reply(RACE, 0, WWAN, WLAN)], 0.0)
    assert [command.path for command in cloud.commands if isinstance(command, Send)] == [WWAN]


def test_a_copy_that_comes_again_and_again_under_other_services_is_rejected_once() -> None:
    cloud = Cloud()
    for number in range(100):
        refused = RejectionMessage(request_id(1), 0, RejectReason.NOT_OFFERED, f"no server for /service_{number}")
        cloud.answers.send([Reply(ReplyTo(WLAN, 0), ECHO, refused, Priority.NORMAL, 5.0, 10.0)], 0.0)
    assert len(cloud.answers) == 1
