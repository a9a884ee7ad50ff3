from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from sidecar.core import requests as requests_module
from sidecar.core.calling_off import MAX_CALLED_OFF, SMALL_ANSWER_BYTES
from sidecar.core.copies import OBSERVED_ONE_IN
from sidecar.core.events import (
    ApplicationEvent,
    DeadlineMissed,
    RejectReason,
    RequestFailed,
    RequestId,
    ResponseArrived,
)
from sidecar.core.link_events import LinkCommand, Send
from sidecar.core.mapping import MappingTable
from sidecar.core.measurements import Measurements
from sidecar.core.messages import (
    MAX_PAYLOAD_BYTES,
    CancelMessage,
    Encoded,
    RejectionMessage,
    RequestMessage,
    ResponseMessage,
    decode_message,
)
from sidecar.core.offers import Offers
from sidecar.core.outbox import Outbox
from sidecar.core.path_id import PathId, PathState
from sidecar.core.priority import Priority
from sidecar.core.requests import MAX_COPIES, RequestParts, RequestTable
from sidecar.core.routes import Routes
from sidecar.core.rules import ServiceRule
from sidecar.core.stats import EngineStats
from tests.unit.sidecar.core.builders import ECHO, TYPE, WLAN, WWAN, A, B, path, peer, request_id

if TYPE_CHECKING:
    from protos.model import NodeName

WLAN_A, WWAN_B = path(WLAN, A), path(WWAN, B)
SERVERS = {A: WLAN_A, B: WWAN_B}
RACE = OBSERVED_ONE_IN
"""Number of a request whose copies are all measured."""


class Table:
    """A request table whose commands and events the test reads; wlan0 reaches cloud-a, wwan0 cloud-b."""

    def __init__(self, *, idempotent: bool = True, drop_late: bool = False) -> None:
        self.rule = ServiceRule(ECHO, 1.0, 10.0, idempotent=idempotent, drop_late=drop_late)
        self.routes, self.stats, self.measurements = Routes(), EngineStats(), Measurements()
        self.commands: list[LinkCommand] = []
        self.events: list[ApplicationEvent] = []
        self.sought: list[frozenset[NodeName]] = []
        self.outbox = Outbox(self.routes, self.commands.append, self.stats)
        offers = Offers((self.rule,))
        offers.set_peers([peer(A), peer(B, session=2)])
        mapping = MappingTable(self.routes)
        parts = RequestParts(
            offers,
            mapping,
            self.routes,
            self.outbox,
            self.measurements,
            self.stats,
            self.events.append,
            self.sought.append,
        )
        self.table = RequestTable(parts)
        for known in SERVERS.values():
            self.routes.set_state(known, PathState.UP)

    def submit(self, number: int = 1, payload: bytes = b"question", now: float = 0.0, *, begun: bool = True) -> None:
        self.table.submit(request_id(number), ECHO, TYPE, self.rule, payload, now)
        for command in self.commands if begun else ():
            if isinstance(command, Send):
                command.message.begun = True

    def sent(self) -> list[PathId]:
        """Paths that got copies since the last look."""
        paths = [command.path for command in self.commands if isinstance(command, Send)]
        self.commands.clear()
        return paths

    def cancelled(self) -> list[tuple[PathId, RequestId]]:
        """What was cancelled where; those messages count as delivered."""
        found = []
        for message in list(self.outbox._messages.values()):
            content = decode_message(memoryview(b"".join(message.content)))
            if isinstance(content, CancelMessage):
                assert message.priority is Priority.HIGH
                found.append((message.path, content.request_id))
                self.outbox.drop(message)
        return found

    def latencies(self) -> dict[str, tuple[int, int]]:
        """(answered, lost) by server."""
        reports = self.measurements.take(self.routes, []).latencies
        return {report.server: (sum(report.latency.counts), report.latency.lost) for report in reports}

    def respond(self, server: str = A, copy: int = 0, number: int = 1, now: float = 0.1, size: int = 0) -> None:
        response = ResponseMessage(request_id(number), copy, 0.01, (b"from " + server.encode()).ljust(size))
        self.table.on_response(peer(server).name, response, now)

    def reject(self, reason: RejectReason, server: str = A, copy: int = 0, now: float = 0.1) -> None:
        self.table.on_rejection(peer(server).name, RejectionMessage(request_id(1), copy, reason, "why"), now)

    def change(self, changed: PathId, state: PathState, now: float = 0.1) -> None:
        self.routes.set_state(changed, state)
        self.table.on_path_changed(changed, state, now)

    def only_failure(self) -> RequestFailed:
        (failed,) = [event for event in self.events if isinstance(event, RequestFailed)]
        return failed

    def assert_empty(self) -> None:
        assert self.table.unanswered == 0
        assert not self.table._requests
        assert len(self.outbox) == 0
        assert self.table.next_timer() is None


def test_copies_are_numbered_and_carry_what_is_left_of_the_lifetime() -> None:
    table = Table()
    table.submit()
    sends = [command for command in table.commands if isinstance(command, Send)]
    copies = [decode_message(memoryview(b"".join(send.message.content))) for send in sends]
    assert copies == [
        RequestMessage(request_id(1), copy, Priority.NORMAL, 1.0, 10.0, ECHO, TYPE, memoryview(b"question"))
        for copy in (0, 1)
    ]
    assert table.sent() == [WLAN_A, WWAN_B]


def test_the_first_response_wins_and_in_a_race_the_second_is_counted_and_measured() -> None:
    table = Table()
    table.submit(RACE)
    table.respond(B, copy=1, number=RACE, now=0.2)
    (arrived,) = table.events
    assert arrived == ResponseArrived(request_id(RACE), ECHO, b"from cloud-b", B, WWAN, 0.2, late=False)
    assert table.cancelled() == []
    table.respond(A, copy=0, number=RACE, now=0.3)
    assert len(table.events) == 1
    assert table.stats.duplicate_responses == 1
    latencies = table.measurements.take(table.routes, []).latencies
    assert sum(sum(report.latency.counts) for report in latencies) == 2
    table.assert_empty()


def test_responses_of_the_wrong_server_to_an_unknown_copy_or_request_are_ignored() -> None:
    table = Table()
    table.submit()
    table.respond(B, copy=0)
    table.respond(A, copy=7)
    table.respond(A, number=99)
    assert table.events == []
    assert table.stats.dropped == {
        "answer_from_wrong_server": 1,
        "answer_to_unknown_copy": 1,
        "answer_to_unknown_request": 1,
    }
    table.respond(A, copy=0)
    assert len(table.events) == 1


def test_a_missed_deadline_is_told_once_and_one_more_copy_goes_out() -> None:
    table = Table()
    table.change(WWAN_B, PathState.DOWN)
    table.submit()
    assert table.sent() == [WLAN_A]
    table.change(WWAN_B, PathState.UP)
    assert table.table.next_timer() == 0.5, "to ask another server if A has it and is silent; A does not have it"
    table.table.handle_timer(0.5)
    assert table.sent() == []
    assert table.table.next_timer() == 1.0
    table.table.handle_timer(1.0)
    table.table.handle_timer(1.0)
    (missed,) = table.events
    assert isinstance(missed, DeadlineMissed)
    assert table.sent() == [WWAN_B]
    table.respond(B, copy=1, now=2.0)
    arrived = table.events[-1]
    assert isinstance(arrived, ResponseArrived)
    assert arrived.late


def test_a_late_answer_may_be_dropped_but_the_request_still_ends() -> None:
    table = Table(drop_late=True)
    table.submit()
    table.respond(now=1.5)
    assert [type(event) for event in table.events] == [DeadlineMissed, RequestFailed]
    assert table.only_failure().outcome == "late_dropped"
    assert table.table.unanswered == 0


def test_a_request_that_nobody_answers_ends_with_its_lifetime() -> None:
    table = Table()
    table.submit(RACE)
    for now in (1.0, 10.0, 99.0):
        table.table.handle_timer(now)
    assert table.only_failure().outcome == "failed"
    assert sum(report.latency.lost for report in table.measurements.take(table.routes, []).latencies) == 2
    table.assert_empty()


def test_in_a_race_the_loser_is_called_off_at_the_deadline_and_counts_once() -> None:
    table = Table()
    table.submit(RACE)
    table.respond(A, copy=0, number=RACE)
    assert len(table.table._requests) == 1
    table.table.handle_timer(1.0)
    assert table.cancelled() == [(WWAN_B, request_id(RACE))]
    table.assert_empty()
    table.respond(B, copy=1, number=RACE, now=1.2)
    assert table.stats.duplicate_responses == 1
    latencies = {report.server: report.latency for report in table.measurements.take(table.routes, []).latencies}
    assert (latencies[B].lost, sum(latencies[B].counts)) == (1, 0)


def test_the_first_response_calls_the_other_copies_off() -> None:
    table = Table()
    table.submit()
    table.respond(B, copy=1)
    assert table.cancelled() == [(WLAN_A, request_id(1))]
    assert table.stats.called_off == {(WLAN, A, ECHO): 1}
    table.assert_empty()
    table.respond(A, copy=0)
    assert table.stats.duplicate_responses == 1
    assert not table.stats.dropped
    assert table.latencies() == {}, "to measure the winner alone would flatter its path"


def test_common_misses_are_counted_at_the_deadline_and_once() -> None:
    table = Table()

    def joints() -> list[tuple[int, int]]:
        return [(joint.requests, joint.both_missed) for joint in table.measurements.take(table.routes, []).joints]

    table.submit(1)
    table.respond(A, copy=0)
    assert joints() == [(1, 0)], "settled before its deadline"
    table.submit(2)
    assert joints() == []
    table.table.handle_timer(1.0)
    assert joints() == [(1, 1)]
    table.respond(B, copy=1, number=2, now=1.5)
    table.table.handle_timer(10.0)
    table.submit(RACE, now=20.0)
    table.respond(A, copy=0, number=RACE, now=20.1)
    assert joints() == [], "the other copy of a race is awaited, and late answers change nothing"
    table.table.handle_timer(21.0)
    assert joints() == [(1, 0)]


def test_a_cancel_takes_the_best_path_to_its_server_and_none_when_there_is_none() -> None:
    table = Table()
    other = path(WWAN, A)
    table.submit()
    table.routes.set_state(other, PathState.UP)
    table.routes.set_state(WLAN_A, PathState.UNSTABLE)
    table.respond(B, copy=1)
    assert table.cancelled() == [(other, request_id(1))]
    table.submit(2)
    for down in (WLAN_A, other):
        table.routes.set_state(down, PathState.DOWN)
    table.respond(B, copy=1, number=2)
    assert table.cancelled() == []


def test_a_server_that_got_nothing_is_told_nothing() -> None:
    table = Table()
    table.submit(begun=False)
    table.respond(B, copy=1)
    assert table.cancelled() == []
    assert table.stats.called_off == {(WLAN, A, ECHO): 1}
    table.assert_empty()


def test_all_copies_at_one_server_are_called_off_with_one_cancel() -> None:
    """It has run already where it won: what the cancel saves is the second answer."""
    table = Table(idempotent=False)
    table.routes.set_state(WWAN_B, PathState.DOWN)
    table.routes.set_state(path(WWAN, A), PathState.UP)
    table.submit()
    assert table.sent() == [WLAN_A, path(WWAN, A)]
    table.respond(A, copy=0, size=SMALL_ANSWER_BYTES + 1)
    assert table.cancelled() == [(WLAN_A, request_id(1))]
    assert table.stats.called_off == {(WWAN, A, ECHO): 1}
    table.assert_empty()


def test_a_server_whose_answer_was_small_is_not_told_to_spare_the_same_answer() -> None:
    table = Table()
    table.routes.set_state(WWAN_B, PathState.DOWN)
    table.routes.set_state(path(WWAN, A), PathState.UP)
    table.submit()
    assert table.sent() == [WLAN_A, path(WWAN, A)]
    table.respond(A, copy=0, size=SMALL_ANSWER_BYTES)
    assert table.cancelled() == []
    assert table.stats.called_off == {(WWAN, A, ECHO): 1}
    table.respond(A, copy=1)
    assert table.stats.duplicate_responses == 1
    table.assert_empty()


def test_a_single_copy_is_always_measured() -> None:
    table = Table()
    table.routes.set_state(WWAN_B, PathState.DOWN)
    table.submit()
    table.respond(A, copy=0)
    assert table.latencies() == {A: (1, 0)}
    assert table.cancelled() == []


def test_a_request_is_measured_with_all_its_copies_or_not_at_all() -> None:
    table = Table()
    for number in range(1, 65):
        table.submit(number)
        table.respond(A, copy=0, number=number)
        if number % 2:
            table.respond(B, copy=1, number=number, now=0.2)
    for now in (1.0, 10.0):
        table.table.handle_timer(now)
    races = 64 // OBSERVED_ONE_IN
    assert table.latencies() == {A: (races, 0), B: (0, races)}, "all races have even numbers"
    table.cancelled()
    table.assert_empty()


def test_ids_of_what_was_called_off_are_kept_for_a_while_only() -> None:
    table = Table()
    for number in range(1, 2 * MAX_CALLED_OFF):
        table.submit(number)
        table.respond(A, number=number)
    assert len(table.table._calling_off) == MAX_CALLED_OFF


def test_an_answer_from_a_server_given_up_still_counts_but_is_not_measured_twice() -> None:
    table = Table()
    table.submit(RACE)
    table.table.on_peer_gone(A, 0.1)
    table.respond(A, copy=0, number=RACE)
    assert isinstance(table.events[0], ResponseArrived)
    latencies = {report.server: report.latency for report in table.measurements.take(table.routes, []).latencies}
    assert (latencies[A].lost, sum(latencies[A].counts)) == (1, 0)


def test_with_no_path_the_request_waits_for_the_first_one_that_comes_up() -> None:
    table = Table()
    for known in SERVERS.values():
        table.routes.set_state(known, PathState.DOWN)
    table.submit()
    assert table.sent() == []
    table.change(WWAN_B, PathState.UP)
    assert table.sent() == [WWAN_B]


@pytest.mark.parametrize("state", [PathState.UNSTABLE, PathState.DOWN])
def test_trouble_on_the_only_path_sends_a_copy_elsewhere_if_idempotent(state: PathState) -> None:
    for idempotent, rescued in ((True, [WWAN_B]), (False, [])):
        table = Table(idempotent=idempotent)
        table.routes.set_state(WWAN_B, PathState.DOWN)
        table.submit()
        assert table.sent() == [WLAN_A]
        table.routes.set_state(WWAN_B, PathState.UP)
        table.change(WLAN_A, state)
        assert table.sent() == rescued


def test_flapping_paths_do_not_multiply_copies_without_end() -> None:
    table = Table()
    table.submit()
    for turn in range(50):
        for known in SERVERS.values():
            table.change(known, PathState.UNSTABLE, now=turn * 0.01)
        for known in SERVERS.values():
            table.change(known, PathState.UP, now=turn * 0.01)
    assert len(table.sent()) <= MAX_COPIES


@pytest.mark.parametrize("reason", RejectReason)
def test_a_rejected_request_goes_to_another_server_only_where_that_is_allowed(reason: RejectReason) -> None:
    table = Table(idempotent=False)
    table.submit()
    assert table.sent() == [WLAN_A]
    table.reject(reason)
    if reason.certainly_not_run:
        assert table.sent() == [WWAN_B]
        assert table.events == []
        table.respond(B, copy=1)
        assert isinstance(table.events[0], ResponseArrived)
    else:
        assert table.sent() == []
        assert table.only_failure().outcome == "rejected"
    table.assert_empty()


def test_a_request_that_all_servers_reject_fails_with_the_last_reason() -> None:
    table = Table()
    table.submit()
    table.reject(RejectReason.OVERLOADED, A, 0)
    assert table.events == []
    table.reject(RejectReason.BAD_PAYLOAD, B, 1)
    assert "bad payload: why" in table.only_failure().reason
    table.assert_empty()


@pytest.mark.parametrize("reason", [RejectReason.NOT_OFFERED, RejectReason.BAD_PAYLOAD])
def test_who_refused_while_starting_is_asked_again_when_all_else_is_lost(reason: RejectReason) -> None:
    """A cloud's sidecar is up before its ROS side is; meanwhile the other cloud dies."""
    table = Table()
    table.submit()
    table.sent()
    table.reject(reason, B, 1)
    assert table.sent() == [], "the other copy is on its way"
    table.change(WLAN_A, PathState.DOWN)
    assert table.sent() == ([WWAN_B] if reason.certainly_not_run else [])
    assert table.events == []


def test_a_second_rejection_of_a_copy_changes_nothing() -> None:
    table = Table()
    table.submit()
    table.sent()
    for _ in range(5):
        table.reject(RejectReason.OVERLOADED, A, 0)
    assert table.sent() == []
    assert table.events == []


def test_when_its_server_goes_a_request_that_may_not_run_twice_fails_and_another_is_sent_on() -> None:
    table = Table(idempotent=False)
    table.submit()
    table.table.on_peer_gone(A, 0.1)
    assert "may have run" in table.only_failure().reason
    table = Table()
    table.routes.set_state(WWAN_B, PathState.DOWN)
    table.submit()
    table.routes.set_state(WWAN_B, PathState.UP)
    table.routes.forget_peer(A)
    table.sent()
    table.table.on_peer_gone(A, 0.1)
    assert table.sent() == [WWAN_B]
    assert table.events == []


def test_what_cannot_be_sent_is_rejected_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    table = Table()
    table.submit(payload=bytes(MAX_PAYLOAD_BYTES + 1))
    assert "limit" in table.only_failure().reason
    table.events.clear()
    table.submit()
    table.submit()
    assert "identity" in table.only_failure().reason
    table.events.clear()
    monkeypatch.setattr(requests_module, "MAX_IN_FLIGHT", 1)
    table.submit(2)
    assert "in flight" in table.only_failure().reason
    assert table.stats.requests[ECHO, "rejected"] == 3


def test_requests_that_wait_are_capped_in_bytes_and_leave_room_when_they_end(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(requests_module, "MAX_HELD_BYTES", 1000)
    table = Table()
    table.submit(1, payload=bytes(600))
    table.submit(2, payload=bytes(600))
    assert "bytes already" in table.only_failure().reason
    table.table.handle_timer(1.0)
    table.table.handle_timer(100.0)
    table.events.clear()
    table.submit(3, payload=bytes(600), now=100.0)
    assert not table.events


def test_a_full_outbox_towards_one_server_sends_to_the_other_only_and_two_full_ones_reject() -> None:
    table = Table()
    huge = Encoded(b"", bytes(8_000_000))
    while table.outbox.send(WLAN_A, huge, priority=Priority.NORMAL, deadline=9.0, expires=9.0) is not None:
        pass
    table.sent()
    table.submit(1, payload=bytes(8_000_000))
    assert table.sent() == [WWAN_B]
    while table.outbox.send(WWAN_B, huge, priority=Priority.NORMAL, deadline=9.0, expires=9.0) is not None:
        pass
    table.submit(2, payload=bytes(8_000_000))
    assert table.only_failure().outcome == "rejected"


def test_a_request_without_any_path_has_the_links_look_for_one() -> None:
    table = Table()
    table.submit(1)
    assert not table.sought
    for known in SERVERS.values():
        table.routes.set_state(known, PathState.DOWN)
    table.submit(2)
    assert table.sought == [frozenset((A, B))]
