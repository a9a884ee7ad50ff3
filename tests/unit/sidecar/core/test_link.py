from __future__ import annotations

import random
from dataclasses import replace
from typing import Any

import pytest

from protos.model import InterfaceId, InterfaceName, NodeName, Role, SessionId
from sidecar.core import frame, pmtu
from sidecar.core.frame import AckFrame, Finished, Fragment, Probe, ProbeReply
from sidecar.core.introduction import Introduction
from sidecar.core.link import Link
from sidecar.core.link_events import (
    FinishedLost,
    FragmentsLost,
    FragmentsReceived,
    MessageFinished,
    PathChanged,
    PathMeasured,
    PeerClosed,
    PeerRestarted,
    Rebind,
    Resend,
    Send,
    SendClose,
    SendFinished,
    SetCarrier,
    SetCredential,
    SetPeers,
    SetReady,
)
from sidecar.core.path_id import PathId, PathState
from sidecar.core.path_table import MAX_PATHS_OF_A_PEER
from sidecar.core.paths import DOWN_FACTOR, DOWN_FLOOR_S, FIRST_PROBE_S, IDLE_PROBE_S, MAX_PROBE_S
from sidecar.core.received import MAX_ACK_DELAY_S
from sidecar.core.rtt import UNSTABLE_FLOOR_S
from tests.sessions import credential_of
from tests.unit.sidecar.core.builders import (
    OUR_INCARNATION,
    OUR_NAME,
    OUR_SESSION,
    PEER_ADDRESS,
    PEER_SESSION,
    WLAN,
    A,
    Bench,
    message,
)

PATH = PathId(WLAN, A, InterfaceId(0))
OTHER_SESSION = SessionId(99)
OUR_INTRODUCTION = Introduction(0, credential_of(OUR_NAME, Role.ROBOT, OUR_SESSION, OUR_INCARNATION))


def numbers(datagrams: list[bytes]) -> list[int]:
    return [frame.decode_header(datagram).packet_number for datagram in datagrams]


def up() -> Bench:
    bench = Bench()
    (introduction,) = bench.frames(bench.sent())
    assert isinstance(introduction, Introduction)
    bench.now += 0.01
    bench.receive(frame.encode_probe_reply(ProbeReply(introduction.probe_id)))
    assert PathChanged(PATH, PathState.UP, "answers") in bench.events()
    bench.sent()
    return bench


def fragment(number: int = 1, size: int = 100) -> bytes:
    return frame.encode_fragment_head(number, size, frame.BASE_SYMBOL_BYTES, 0) + bytes(size)


def state_changes(bench: Bench) -> list[PathState]:
    return [event.state for event in bench.events() if isinstance(event, PathChanged)]


# -- life of a path ---------------------------------------------------------------------------------------------------


def test_a_new_path_introduces_itself_and_probes() -> None:
    bench = Bench()
    (datagram,) = bench.sent()
    header = frame.decode_header(datagram)
    assert header[:3] == (3, 0, 0x0102030405060708)
    assert bench.frames([datagram]) == [OUR_INTRODUCTION]


def test_no_probe_leaves_before_the_interface_is_ready() -> None:
    bench = Bench()
    bench.execute(SetReady(ready=False))
    assert bench.wait(3.0) == []
    bench.execute(SetReady(ready=True))
    assert bench.frames(bench.sent()) == [OUR_INTRODUCTION]


def test_probes_to_a_silent_peer_back_off() -> None:
    bench = Bench()
    assert len(bench.sent() + bench.wait(1.0)) in range(5, 9)
    bench.wait(10.0)
    assert len(bench.wait(10.0)) == pytest.approx(10.0 / MAX_PROBE_S, abs=1)


def test_an_answer_brings_the_path_up_with_its_round_trip_time_told_first() -> None:
    bench = Bench()
    bench.sent()
    bench.now += 0.02
    bench.receive(frame.encode_probe_reply(ProbeReply(0)))
    measured, changed = bench.events()
    assert isinstance(measured, PathMeasured)
    assert measured.smoothed_rtt_s == pytest.approx(0.02)
    assert changed == PathChanged(PATH, PathState.UP, "answers")


def test_silence_makes_it_unstable_then_down_and_an_answer_up_again() -> None:
    bench = up()
    bench.wait(IDLE_PROBE_S + 0.01)
    bench.wait(UNSTABLE_FLOOR_S)
    assert state_changes(bench) == [PathState.UNSTABLE]
    probes = bench.wait(0.3)
    assert 4 <= len(probes) <= 8, "one every 50 ms"
    bench.wait(max(DOWN_FACTOR * UNSTABLE_FLOOR_S, DOWN_FLOOR_S))
    assert state_changes(bench) == [PathState.DOWN]
    (introduction,) = bench.frames(bench.wait(2.0)[-1:])
    assert isinstance(introduction, Introduction)
    bench.receive(frame.encode_probe_reply(ProbeReply(introduction.probe_id)))
    assert state_changes(bench) == [PathState.UP]


def test_a_living_path_stays_up_with_two_probes_a_second() -> None:
    bench = up()
    sent = 0
    for _ in range(100):
        for item in bench.frames(bench.wait(0.05)):
            assert isinstance(item, Probe)
            sent += 1
            bench.now += 0.001
            bench.receive(frame.encode_probe_reply(ProbeReply(item.id)))
    assert state_changes(bench) == []
    assert 8 <= sent <= 12


def test_a_path_that_goes_down_hands_back_what_it_carried_once() -> None:
    bench = up()
    outbound = message(size=300_000)
    bench.execute(Send(PATH, outbound))
    sent = bench.sent()
    assert len(sent) < outbound.count, "the window holds the rest back"
    bench.wait(3.0)
    lost = [index for event in bench.events() if isinstance(event, FragmentsLost) for index in event.indices]
    assert sorted(lost) == list(range(outbound.count))


def test_sending_over_a_path_that_is_not_usable_says_so_and_hands_back() -> None:
    for target in (PATH, PathId(WLAN, NodeName("nobody"), InterfaceId(9))):
        bench, outbound = Bench(), message()
        bench.execute(Send(target, outbound))
        bench.execute(Resend(target, outbound, (1,)))
        assert bench.events() == [
            PathChanged(target, PathState.DOWN, "not usable here"),
            FragmentsLost(target, outbound, (0, 1, 2)),
            PathChanged(target, PathState.DOWN, "not usable here"),
            FragmentsLost(target, outbound, (1,)),
        ]


# -- the interface itself changes -------------------------------------------------------------------------------------


def test_a_lost_carrier_takes_every_path_down_at_once_and_hands_back_what_they_carried() -> None:
    bench = up()
    sent = message()
    bench.link.execute(Send(PATH, sent), bench.now)
    bench.sent()
    bench.link.execute(SetCarrier(False), bench.now)
    events = bench.events()
    assert PathChanged(PATH, PathState.DOWN, "no carrier") in events
    assert [event.message for event in events if isinstance(event, FragmentsLost)] == [sent]
    bench.now += 10
    assert bench.sent() == [], "nothing is probed without a carrier"
    bench.link.execute(SetCarrier(True), bench.now)
    assert [type(item) for item in bench.frames(bench.sent())] == [Introduction]


def test_what_was_under_way_when_the_carrier_went_does_not_bring_the_path_up() -> None:
    bench = up()
    bench.link.execute(Send(PATH, message()), bench.now)
    number = numbers(bench.sent())[0]
    bench.link.execute(SetCarrier(False), bench.now)
    bench.events()
    bench.receive(frame.encode_ack(((number, number),), 0.0))
    assert state_changes(bench) == []


def test_a_rebinding_makes_a_path_unstable_until_it_answers_and_resends_what_was_under_way() -> None:
    bench = up()
    sent = message()
    bench.link.execute(Send(PATH, sent), bench.now)
    bench.sent()
    bench.now += 0.001
    bench.link.execute(Rebind(), bench.now)
    events = bench.events()
    assert PathChanged(PATH, PathState.UNSTABLE, "rebinding") in events
    lost = [event for event in events if isinstance(event, FragmentsLost)]
    assert lost == [FragmentsLost(PATH, sent, tuple(range(sent.count)), timed_out=True)]
    (probe,) = [item for item in bench.frames(bench.sent()) if isinstance(item, Probe)]
    bench.now += 0.03
    bench.receive(frame.encode_probe_reply(ProbeReply(probe.id)))
    assert state_changes(bench) == [PathState.UP]
    bench.link.handle_timer(bench.now + 1)
    assert bench.link.stats.paths[A].srtt_s == pytest.approx(0.03), "the round-trip time is the new way's alone"


NEW_INTERFACE = InterfaceId(8)
NEW_PATH = PathId(WLAN, A, NEW_INTERFACE)
ELSEWHERE = ("203.0.113.9", 666)


def introduce(bench: Bench, number: int, **changes: Any) -> None:
    """The peer introduces itself from an interface that no view has named."""
    bench.receive_datagram(bench.introduction(**{"number": number, "interface": NEW_INTERFACE, **changes}))


def test_a_peers_new_interface_is_known_by_its_introduction_before_any_view_names_it() -> None:
    bench = up()
    introduce(bench, 0)
    reply, probe = bench.frames(bench.sent())
    assert reply == ProbeReply(77)
    assert isinstance(probe, Probe)
    answer = bench.datagram(frame.encode_probe_reply(ProbeReply(probe.id)), number=1, interface=NEW_INTERFACE)
    bench.now += 0.01
    bench.receive_datagram(answer)
    assert PathChanged(NEW_PATH, PathState.UP, "answers") in bench.events()
    bench.know()  # a view that still does not name it
    assert state_changes(bench) == []
    assert bench.link.in_use(PEER_ADDRESS)


def test_an_introduction_is_answered_where_it_came_from_in_fewer_bytes_and_moves_nothing() -> None:
    bench = up()
    question = bench.introduction(number=50)
    bench.receive_datagram(question, ELSEWHERE)
    (answer,) = bench.link.batches_to_send(bench.now)
    assert answer.address == ELSEWHERE
    assert len(answer.data) < len(question)
    assert bench.events() == []
    assert bench.link.in_use(PEER_ADDRESS)
    assert not bench.link.in_use(ELSEWHERE)


def test_who_introduces_itself_again_after_an_answer_is_introduced_to_at_that_place() -> None:
    """It can not read the answer of a session that it does not know yet."""
    bench = up()
    for number in (0, 1):
        bench.receive_datagram(bench.introduction(number=number, interface=NEW_INTERFACE), ELSEWHERE)
        answers = bench.frames(bench.sent() + bench.wait(FIRST_PROBE_S))
        assert any(isinstance(item, Introduction) for item in answers) is (number == 1)


def test_a_credential_signed_anew_is_introduced_from_then_on() -> None:
    bench = Bench()
    (before,) = bench.frames(bench.sent())
    renewed = replace(bench.own.credential, certificate=b"renewed", signature=b"again")
    bench.execute(SetCredential(renewed.encode()))
    (after,) = bench.frames(bench.wait(FIRST_PROBE_S * 1.2))
    assert before == OUR_INTRODUCTION
    assert after == Introduction(1, renewed)


def test_introductions_that_find_the_path_down_bring_few_of_ours_to_where_they_come_from() -> None:
    """The peer may not know our session; but who knows its token must not make us flood others."""
    bench = Bench()
    bench.wait(10.0)
    ours = 0
    start = bench.now
    for number in range(1000):
        bench.now += 0.001
        bench.receive_datagram(bench.introduction(number=number), ELSEWHERE)
        for batch in bench.link.batches_to_send(bench.now):
            if batch.address == ELSEWHERE:
                ours += sum(isinstance(item, Introduction) for item in bench.frames(map(bytes, batch.cut())))
    assert 1 <= ours <= (bench.now - start) / FIRST_PROBE_S + 1


def test_an_introduction_that_comes_again_is_not_answered_once_something_newer_was_authentic() -> None:
    bench = up()
    again = bench.introduction(number=5)
    bench.receive(PROBE, number=6)
    bench.sent()
    bench.receive_datagram(again, ELSEWHERE)
    assert bench.sent() == []
    assert bench.link.stats.dropped == {"duplicate": 1}


def test_introductions_do_not_keep_sealed_datagrams_out() -> None:
    """Whoever knows the token could send one with the largest packet number."""
    bench = up()
    bench.receive_datagram(bench.introduction(number=2**64 - 1))
    bench.sent()
    bench.receive(PROBE)
    assert bench.frames(bench.sent()) == [ProbeReply(1)]
    assert bench.link.stats.dropped == {}


def test_a_wrong_token_introduces_nobody_and_nothing_changed_on_the_way_does() -> None:
    bench = up()
    introduce(bench, 0, token=bytes(16))
    introduce(bench, 0, receiver=NodeName("robot-2"))
    changed = bytearray(bench.introduction(number=0, interface=NEW_INTERFACE))
    changed[60] ^= 1
    bench.receive_datagram(bytes(changed))
    introduce(bench, 0, name=NodeName("cloud-b"))
    assert bench.sent() == []
    assert bench.link.stats.dropped == {"unknown_introducer": 1, "unauthentic": 2, "malformed": 1}


def test_introduced_paths_are_capped_and_unproven_ones_make_room() -> None:
    bench = up()
    for interface in range(10, 10 + MAX_PATHS_OF_A_PEER):
        introduce(bench, 0, interface=InterfaceId(interface))
    assert len(bench.link._paths) == MAX_PATHS_OF_A_PEER
    assert (A, InterfaceId(0)) in bench.link._paths, "the one that the view names and that lives"
    for path in bench.link._paths.values():
        path.remote = path.remote or ELSEWHERE
    introduce(bench, 0)
    assert bench.link.stats.dropped == {"paths_full": 1}
    bench.wait(1.0)


def test_an_introduced_path_that_is_down_is_forgotten_with_the_next_view_but_its_numbers_are_not() -> None:
    bench = up()
    introduce(bench, 0)
    bench.sent()
    sealed = bench.datagram(PROBE, number=1, interface=NEW_INTERFACE)
    bench.receive_datagram(sealed)
    first = numbers(bench.sent())
    bench.know()
    introduce(bench, 2)
    bench.receive_datagram(sealed)
    assert bench.link.stats.dropped == {"duplicate": 1}
    assert numbers(bench.sent())[0] > first[-1], "packet numbers go on"


def test_a_path_that_lives_outlives_a_view_that_forgot_it() -> None:
    """The control plane may have heard of the interface's end and not yet of its return."""
    bench = up()
    bench.link.execute(SetPeers((bench.link_peer(addresses=()),)), bench.now)
    assert state_changes(bench) == []
    bench.wait(30.0)
    assert state_changes(bench)[-1] is PathState.DOWN
    bench.link.execute(SetPeers((bench.link_peer(addresses=()),)), bench.now)
    assert bench.wait(10.0) == [], "nothing is left of it"


def test_a_link_opened_anew_goes_on_with_the_packet_numbers_of_the_one_before() -> None:
    bench = up()
    bench.receive(PROBE, number=9)
    first = numbers(bench.sent())[-1] + 1
    old = bench.link
    bench.link = Link(old.identity, random.Random(2), bench.now, old.remember())
    bench.know()
    bench.execute(SetReady(ready=True))
    assert numbers(bench.sent())[0] == first
    bench.receive(PROBE, number=9)
    assert bench.link.stats.dropped == {"duplicate": 1}, "what the one before received is not received again"


def test_a_link_whose_driver_hangs_keeps_packet_numbers_for_what_it_may_yet_seal() -> None:
    bench = up()
    bench.execute(Send(PATH, message(size=30_000)))
    memory = bench.link.remember(hangs=True)
    assert max(numbers(bench.sent())) < memory.next_number


def test_the_peers_newest_address_is_followed() -> None:
    bench = up()
    moved = ("198.51.100.1", 5)
    bench.receive_datagram(bench.datagram(frame.encode_probe(Probe(1)), number=50), moved)
    bench.receive_datagram(bench.datagram(frame.encode_probe(Probe(2)), number=40))
    (batch,) = bench.link.batches_to_send(bench.now)
    assert batch.address == moved


# -- messages ---------------------------------------------------------------------------------------------------------


def test_a_message_goes_out_in_numbered_datagrams_and_is_acknowledged() -> None:
    bench, outbound = up(), message(size=3000)
    bench.execute(Send(PATH, outbound))
    sent = bench.sent()
    assert [item.symbol_index for item in bench.frames(sent) if isinstance(item, Fragment)] == [0, 1, 2]
    first = numbers(sent)[0]
    assert numbers(sent) == [first, first + 1, first + 2]
    assert all(len(datagram) <= pmtu.BASE_BYTES for datagram in sent)
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


# -- bad input: dropped, counted, and nothing is sent back ------------------------------------------------------------


PROBE = frame.encode_probe(Probe(1))


def good(**changes: Any) -> bytes:
    return Bench().datagram(PROBE, **{"number": 10, **changes})


def flipped(datagram: bytes, position: int) -> bytes:
    changed = bytearray(datagram)
    changed[position] ^= 0x10
    return bytes(changed)


BAD = {
    "garbage": (b"\xff" * 100, "malformed"),
    "empty": (b"", "malformed"),
    "truncated header": (good()[:19], "malformed"),
    "no room for a frame": (good()[:36], "malformed"),
    "another version": (b"\xd1" + good()[1:], "version"),
    "unsealed": (b"\xd2\x00" + good()[2:], "unsealed"),
    "unknown flags": (b"\xd2\x09" + good()[2:], "malformed"),
    "a frame in clear": (b"\xd2\x01" + good()[2:20] + PROBE.ljust(40, b"\0"), "unauthentic"),
    "another phase of the keys": (b"\xd2\x03" + good()[2:], "unauthentic"),
    "a changed packet number": (flipped(good(), 19), "unauthentic"),
    "a changed frame": (flipped(good(), 22), "unauthentic"),
    "a changed tag": (flipped(good(), -1), "unauthentic"),
    "cut short": (good()[:-1], "unauthentic"),
    "lengthened": (good() + b"\0", "unauthentic"),
    "good frame then garbage": (Bench().datagram(PROBE, b"\xff", number=10), "malformed"),
    "wrong interface": (good(receiver=InterfaceId(4)), "wrong_interface"),
    "unknown interface of the peer": (good(interface=InterfaceId(8)), "unknown_path"),
    "unknown session": (good(session=OTHER_SESSION), "unknown_session"),
    "a stranger's introduction": (Bench().introduction(token=bytes(16), session=OTHER_SESSION), "unknown_introducer"),
    "an introduction cut short": (Bench().introduction()[:60], "unauthentic"),
    "an introduction of nearly nothing": (Bench().introduction()[:37], "unauthentic"),
    "a peer's introduction from before its restart": (
        Bench().introduction(session=OTHER_SESSION, incarnation=1),
        "old_introduction",
    ),
}


@pytest.mark.parametrize("kind", BAD)
def test_bad_datagrams_are_counted_and_provoke_nothing(kind: str) -> None:
    datagram, reason = BAD[kind]
    bench = up()
    bench.receive_datagram(datagram, ELSEWHERE)
    assert bench.link.stats.dropped == {reason: 1}
    assert bench.events() == []
    assert bench.sent() == []
    bench.receive(PROBE)
    assert bench.frames(bench.sent()) == [ProbeReply(1)], "the others are still served"


def test_a_duplicate_is_dropped_and_not_answered_again() -> None:
    bench = up()
    for _ in range(3):
        bench.receive(PROBE, number=10)
    assert bench.link.stats.dropped["duplicate"] == 2
    assert bench.frames(bench.sent()) == [ProbeReply(1)]


def test_an_unasked_probe_reply_brings_nothing_up() -> None:
    bench = Bench()
    bench.sent()
    bench.receive(frame.encode_probe_reply(ProbeReply(77)))
    assert state_changes(bench) == []
    assert bench.link.stats.dropped["unasked_probe_reply"] == 1


def test_acknowledging_the_unsent_is_counted_and_changes_nothing() -> None:
    bench, outbound = up(), message()
    bench.execute(Send(PATH, outbound))
    bench.sent()
    bench.receive(frame.encode_ack([(0, 10**6)], 0.0))
    assert bench.link.stats.dropped["acks_the_unsent"] == 1
    assert bytes(outbound.acked) == b"\0\0\0"


def test_a_flood_of_probes_is_answered_in_fewer_bytes_than_it_has() -> None:
    bench = up()
    before = bench.link.stats.bytes.copy()
    for number in range(100, 200):
        bench.receive(PROBE * frame.MAX_FRAMES, number=number)
        bench.sent()
    flood = bench.link.stats.bytes
    assert flood["sent"] - before["sent"] <= flood["received"] - before["received"]


def test_a_flood_to_a_path_that_is_down_provokes_few_probes() -> None:
    bench = Bench()
    bench.wait(10.0)
    introductions = 0
    start = bench.now
    for number in range(1000):
        bench.now += 0.0001
        bench.receive(PROBE, number=number)
        introductions += sum(isinstance(item, Introduction) for item in bench.frames(bench.sent()))
    assert 1 <= introductions <= (bench.now - start) / FIRST_PROBE_S + 1


def test_owed_frames_are_capped() -> None:
    bench = up()
    for number in range(10, 60):
        bench.receive(PROBE * 60, number=number)
    assert bench.link.stats.dropped["pending_frames_full"] == 50 * 60 - 256
    assert len(bench.frames(bench.sent())) == 256


# -- peers ------------------------------------------------------------------------------------------------------------


def test_a_known_peers_newer_start_is_reported() -> None:
    bench = up()
    bench.receive_datagram(bench.introduction(session=OTHER_SESSION, incarnation=2))
    assert bench.events() == [PeerRestarted(A, credential_of(A, Role.CLOUD, OTHER_SESSION, 2))]
    assert bench.sent() == []


def test_a_restarted_peer_starts_afresh_and_our_numbers_go_on() -> None:
    bench, outbound = up(), message()
    bench.execute(Send(PATH, outbound))
    before = numbers(bench.sent())
    bench.know(session=OTHER_SESSION, incarnation=2)
    events = bench.events()
    assert PathChanged(PATH, PathState.DOWN, "peer left or restarted") in events
    assert FragmentsLost(PATH, outbound, (0, 1, 2)) in events
    assert numbers(bench.sent())[0] > before[-1]
    bench.receive_datagram(bench.datagram(PROBE, number=0, session=OTHER_SESSION))
    assert ProbeReply(1) in bench.frames(bench.sent())


def test_a_peer_that_stays_keeps_its_path_when_others_come() -> None:
    bench = up()
    other = bench.link_peer(name=NodeName("cloud-b"), session=OTHER_SESSION, token=bytes(16))
    bench.execute(SetPeers((bench.link_peer(), other)))
    assert state_changes(bench) == []
    (datagram,) = bench.sent()
    assert frame.decode_header(datagram).flags & frame.INTRODUCTION_FLAG, "to the newcomer"


def test_a_peer_that_left_is_forgotten_with_its_timers() -> None:
    bench = up()
    bench.execute(SetPeers(()))
    assert state_changes(bench) == [PathState.DOWN]
    assert bench.wait(5.0) == []
    assert bench.link.next_timer() > bench.now
    bench.receive(PROBE)
    assert bench.link.stats.dropped["unknown_session"] == 1


def test_goodbye_takes_the_path_down_once_and_a_flood_of_it_is_one() -> None:
    bench = up()
    bench.receive(frame.encode_close() * frame.MAX_FRAMES)
    assert bench.events() == [PathChanged(PATH, PathState.DOWN, "peer closed"), PeerClosed(A)]
    bench.receive(frame.encode_close())
    assert bench.events() == []


def test_after_our_goodbye_nothing_makes_us_look_alive() -> None:
    bench = up()
    bench.execute(SendClose())
    assert bench.frames(bench.sent()) == [frame.Close()]
    bench.receive(PROBE)
    assert bench.sent() == []
    assert bench.wait(5.0) == []


def test_stats_tell_what_was_carried() -> None:
    bench = up()
    bench.execute(Send(PATH, message(size=3000)))
    sent = bench.sent()
    bench.wait(0.3)
    stats = bench.link.stats.paths[A]
    assert stats.srtt_s == pytest.approx(0.01)
    assert stats.datagrams_sent >= 4
    assert stats.bytes_sent >= sum(map(len, sent))
    assert bench.link.stats.datagrams["sent", "data"] >= 3
    assert bench.link.stats.interface == InterfaceName("wlan0")
