from __future__ import annotations

import random
from dataclasses import replace

import pytest

from lab.simulated.sessions import credential_of
from plr.protos.model.ids import InterfaceId, InterfaceName, NodeName, Role, SessionId
from plr.sidecar.core.base.values import PathId, PathState
from plr.sidecar.core.link.link import Link
from plr.sidecar.core.path.congestion.rtt import UNSTABLE_FLOOR_S
from plr.sidecar.core.path.path import DOWN_FACTOR, DOWN_FLOOR_S
from plr.sidecar.core.path.probing import IDLE_PROBE_S, MAX_PROBE_S
from plr.sidecar.core.seam.links import (
    CheckPaths,
    FragmentsLost,
    PathChanged,
    PathMeasured,
    PeerClosed,
    PeerRestarted,
    Rebind,
    Resend,
    Send,
    SendClose,
    SetCarrier,
    SetPeers,
    SetReady,
)
from plr.sidecar.core.wire import frame
from plr.sidecar.core.wire.frame import Probe, ProbeReply
from plr.sidecar.core.wire.introduction import Introduction
from tests.support.builders import (
    FIRST,
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
OUR_CREDENTIAL = credential_of(OUR_NAME, Role.ROBOT, OUR_SESSION, OUR_INCARNATION)
ELSEWHERE = ("203.0.113.9", 666)
NO_ADDRESS: frozenset[str] = frozenset()
NO_FAMILY: frozenset[int] = frozenset()
OURS, OURS_TOO, OURS_V6 = "198.51.100.7", "198.51.100.8", "2001:db8::aaaa"
PROBE = frame.encode_probe(Probe(1))


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
    (introduction,) = bench.frames([datagram])
    assert isinstance(introduction, Introduction)
    assert introduction.credential == OUR_CREDENTIAL


def test_no_probe_leaves_before_the_interface_is_ready() -> None:
    bench = Bench()
    bench.execute(SetReady(ready=False))
    assert bench.wait(3.0) == []
    bench.execute(SetReady(ready=True))
    (introduction,) = bench.frames(bench.sent())
    assert isinstance(introduction, Introduction)


def test_probes_to_a_silent_peer_back_off() -> None:
    bench = Bench()
    assert len(bench.sent() + bench.wait(1.0)) in range(5, 9)
    bench.wait(10.0)
    assert len(bench.wait(10.0)) == pytest.approx(10.0 / MAX_PROBE_S, abs=1)


def test_an_answer_brings_the_path_up_with_its_round_trip_time_told_first() -> None:
    bench = Bench()
    (introduction,) = bench.frames(bench.sent())
    assert isinstance(introduction, Introduction)
    bench.now += 0.02
    bench.receive(frame.encode_probe_reply(ProbeReply(introduction.probe_id)))
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
            bench.link.handle_timer(bench.now)
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


def test_paths_of_an_interface_without_address_are_not_said_to_lack_a_carrier() -> None:
    bench = up()
    bench.link.execute(SetCarrier(on=False, why_not="no address"), bench.now)
    assert PathChanged(PATH, PathState.DOWN, "no address") in bench.events()


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
    bench.link.execute(Rebind(NO_ADDRESS, frozenset({4})), bench.now)
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


@pytest.mark.audit("dp-14")
@pytest.mark.parametrize(
    ("source", "command", "concerned"),
    [
        # A temporary IPv6 address is deprecated: an IPv4 path does not care, whatever the driver knows of it.
        (None, Rebind(frozenset({OURS_V6}), NO_FAMILY), False),
        (OURS, Rebind(frozenset({OURS_V6}), NO_FAMILY), False),
        (OURS, Rebind(NO_ADDRESS, frozenset({6})), False),
        (OURS, Rebind(NO_ADDRESS, NO_FAMILY), False),
        # Another address of the same family: it depends on which one the path leaves from.
        (OURS, Rebind(frozenset({OURS_TOO}), NO_FAMILY), False),
        (OURS, Rebind(frozenset({OURS, OURS_V6}), NO_FAMILY), True),
        (None, Rebind(frozenset({OURS_TOO}), NO_FAMILY), True),
        (OURS, Rebind(NO_ADDRESS, frozenset({4, 6})), True),
    ],
)
def test_only_paths_that_left_from_what_is_lost_are_rebound(
    source: str | None, command: Rebind, concerned: bool
) -> None:
    bench = up()
    bench.link.note_source(PATH, lambda remote: source if remote == PEER_ADDRESS else None)
    sent = message()
    bench.link.execute(Send(PATH, sent), bench.now)
    bench.sent()
    bench.link.execute(command, bench.now)
    events = bench.events()
    assert (PathChanged(PATH, PathState.UNSTABLE, "rebinding") in events) is concerned
    assert any(isinstance(event, FragmentsLost) for event in events) is concerned


@pytest.mark.audit("dp-14")
def test_the_driver_is_asked_again_where_a_path_leaves_from_once_it_leads_elsewhere() -> None:
    bench = up()
    bench.link.note_source(PATH, lambda remote: OURS)
    bench.receive_datagram(bench.datagram(fragment()), ELSEWHERE)
    bench.link.execute(Rebind(frozenset({OURS_TOO}), NO_FAMILY), bench.now)
    assert state_changes(bench) == [PathState.UNSTABLE], "the family alone is known again"
    assert bench.link.living() == [PATH]


def test_what_is_down_is_looked_for_at_once_after_any_change_of_addresses() -> None:
    bench = Bench()
    bench.wait(30.0)
    bench.link.execute(Rebind(NO_ADDRESS, NO_FAMILY), bench.now)
    assert bench.frames(bench.sent())


def test_a_path_that_lives_outlives_a_view_that_forgot_it() -> None:
    """The control plane may have heard of the interface's end and not yet of its return."""
    bench = up()
    bench.link.execute(SetPeers((bench.link_peer(addresses=()),)), bench.now)
    assert state_changes(bench) == []
    bench.wait(30.0)
    assert state_changes(bench)[-1] is PathState.DOWN
    bench.link.execute(SetPeers((bench.link_peer(addresses=()),)), bench.now)
    assert bench.wait(10.0) == [], "nothing is left of it"


def test_paths_to_a_removed_peer_end_with_the_reason() -> None:
    bench = up()
    bench.link.execute(SetPeers((), {PATH.peer: "removed by the control plane: it was stopped"}), bench.now)
    changes = [event for event in bench.events() if isinstance(event, PathChanged)]
    assert [(one.state, one.reason) for one in changes] == [
        (PathState.DOWN, "removed by the control plane: it was stopped")
    ]


def test_a_dormant_peer_is_asked_rarely_and_at_once_when_it_is_one_again() -> None:
    bench = up()
    bench.link.execute(SetPeers((replace(bench.link_peer(), dormant=True),)), bench.now)
    bench.wait(3600.0)
    assert 1 <= len(bench.wait(120.0)) <= 4
    assert not bench.link.stats.paths
    assert not list(bench.link.views(bench.now))
    assert not bench.link.path_ids(), "for people it is gone"
    bench.link.execute(SetPeers((bench.link_peer(),)), bench.now)
    assert bench.frames(bench.sent())


def test_a_link_opened_again_goes_on_with_the_packet_numbers_of_the_one_before() -> None:
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


def test_an_idle_path_is_probed_when_its_interface_is_doubted_but_not_without_end() -> None:
    bench = up()
    bench.wait(0.1)
    bench.sent()
    bench.execute(CheckPaths())
    assert [type(one) for one in bench.frames(bench.wait(0.01))] == [Probe]
    for _ in range(10):
        bench.execute(CheckPaths())
    assert bench.wait(0.01) == []


def test_the_peers_newest_address_is_followed() -> None:
    bench = up()
    moved = ("198.51.100.1", 5)
    bench.receive_datagram(bench.datagram(frame.encode_probe(Probe(1)), number=50), moved)
    bench.receive_datagram(bench.datagram(frame.encode_probe(Probe(2)), number=40))
    (batch,) = bench.link.batches_to_send(bench.now)
    assert batch.address == moved


def test_a_robot_stays_with_the_address_that_answers_when_the_peer_uses_another_that_is_known() -> None:
    bench = up()
    known, unknown = ("192.0.2.2", 4000), ("198.51.100.1", 5)
    bench.execute(SetPeers((bench.link_peer(addresses=((FIRST, (PEER_ADDRESS, known)),)),)))
    for number, (source, followed) in enumerate(
        [(known, PEER_ADDRESS), (unknown, unknown), (known, known), (PEER_ADDRESS, known)], 50
    ):
        bench.receive_datagram(bench.datagram(frame.encode_probe(Probe(number)), number=number), source)
        (batch,) = bench.link.batches_to_send(bench.now)
        assert batch.address == followed


# -- peers ------------------------------------------------------------------------------------------------------------


def test_a_known_peers_newer_start_is_reported() -> None:
    bench = up()
    bench.receive_datagram(bench.introduction(session=OTHER_SESSION, incarnation=2))
    assert bench.events() == [PeerRestarted(A, credential_of(A, Role.CLOUD, OTHER_SESSION, 2), at_home=True)]
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
    assert bench.events() == [PathChanged(PATH, PathState.DOWN, "peer closed"), PeerClosed(A, PEER_SESSION)]
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
