"""How a link introduces its session and takes the introductions of others: they prove little and move nothing."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from plr.protos.model.ids import InterfaceId, NodeName
from plr.sidecar.core.base.values import PathId, PathState
from plr.sidecar.core.link.path_table import MAX_PATHS_OF_A_PEER, NEW_PATHS, NEW_PATHS_PER_S
from plr.sidecar.core.path.congestion.rtt import LONGEST_ANSWER_S
from plr.sidecar.core.path.probing import FIRST_PROBE_S
from plr.sidecar.core.seam.links import PathChanged, SetCredential, SetPeers
from plr.sidecar.core.wire import frame
from plr.sidecar.core.wire.frame import Probe, ProbeReply
from plr.sidecar.core.wire.introduction import Introduction
from tests.support.builders import PEER_ADDRESS, WLAN, A, Bench
from tests.unit.sidecar.core.link.test_link import (
    ELSEWHERE,
    OUR_CREDENTIAL,
    PROBE,
    numbers,
    state_changes,
    up,
)

NEW_INTERFACE = InterfaceId(8)
NEW_PATH = PathId(WLAN, A, NEW_INTERFACE)


def introduce(bench: Bench, number: int, **changes: Any) -> None:
    """The peer introduces itself from an interface that no view has named."""
    bench.receive_datagram(bench.introduction(**{"number": number, "interface": NEW_INTERFACE, **changes}))


def test_a_peers_new_interface_is_known_by_its_introduction_before_any_view_names_it() -> None:
    bench = up()
    introduce(bench, 0)
    reply, probe, offer = bench.frames(bench.sent())
    assert reply == ProbeReply(77)
    assert isinstance(probe, Probe)
    assert isinstance(offer, frame.KeyOffer)
    answer = bench.datagram(frame.encode_probe_reply(ProbeReply(probe.id)), number=1, interface=NEW_INTERFACE)
    bench.now += 0.01
    bench.receive_datagram(answer)
    assert PathChanged(NEW_PATH, PathState.UP, "answers") in bench.events()
    bench.know()  # a view that still does not name it
    assert state_changes(bench) == []
    assert bench.link.in_use(PEER_ADDRESS)


def test_a_dormant_peer_that_introduces_itself_has_no_path_for_people_until_it_hears_the_answer() -> None:
    bench = Bench()
    nowhere = bench.link_peer(addresses=())
    bench.execute(SetPeers((replace(nowhere, dormant=True),)))
    introduce(bench, 0)
    assert not bench.link.heard_dormant(bench.now), "it may hear this answer"
    bench.sent()
    bench.wait(FIRST_PROBE_S)
    introduce(bench, 1)
    assert bench.link.heard_dormant(bench.now) == {A}
    assert not list(bench.link.views(bench.now))
    assert not bench.link.path_ids()
    assert not bench.link.stats.paths
    probe = next(item for item in bench.frames(bench.sent()) if isinstance(item, Probe))
    bench.now += 0.01
    bench.receive_datagram(
        bench.datagram(frame.encode_probe_reply(ProbeReply(probe.id)), number=2, interface=NEW_INTERFACE)
    )
    assert PathChanged(NEW_PATH, PathState.UP, "answers") in bench.events()
    assert bench.link.path_ids() == {NEW_PATH}, "the link is told a little later that it is a peer again"
    assert not bench.link.heard_dormant(bench.now)
    bench.execute(SetPeers((nowhere,)))
    bench.wait(60.0)
    (view,) = bench.link.views(bench.now)
    assert view.state is PathState.DOWN, "a path of a peer is shown when it is down"


def begun() -> tuple[Bench, bytes]:
    """A link that answered the introduction of a peer's new interface, and what that peer answers then."""
    bench = up()
    introduce(bench, 0)
    _, probe, _ = bench.frames(bench.sent())
    assert isinstance(probe, Probe)
    answer = bench.datagram(frame.encode_probe_reply(ProbeReply(probe.id)), number=1, interface=NEW_INTERFACE)
    bench.now += 0.01
    return bench, answer


def test_a_path_that_an_introduction_began_outlives_views_that_do_not_name_it() -> None:
    bench, answer = begun()
    bench.know()
    bench.receive_datagram(answer)
    assert PathChanged(NEW_PATH, PathState.UP, "answers") in bench.events()


def test_a_path_whose_introduction_led_to_nothing_ends_with_the_next_view() -> None:
    bench, _ = begun()
    bench.now += LONGEST_ANSWER_S
    assert NEW_PATH in bench.link.path_ids()
    bench.know()
    assert NEW_PATH not in bench.link.path_ids()


def test_no_more_paths_that_introductions_began_outlive_a_view_than_a_peer_may_have() -> None:
    bench = up()
    for number in range(MAX_PATHS_OF_A_PEER):
        introduce(bench, number, interface=InterfaceId(100 + number))
        bench.sent()
    more = tuple((InterfaceId(number), (PEER_ADDRESS,)) for number in range(4))
    bench.execute(SetPeers((bench.link_peer(addresses=more),)))
    assert len(bench.link.path_ids()) == MAX_PATHS_OF_A_PEER


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
    """It cannot read the answer of a session that it does not know yet."""
    bench = up()
    for number in (0, 1):
        bench.receive_datagram(bench.introduction(number=number, interface=NEW_INTERFACE), ELSEWHERE)
        answers = bench.frames(bench.sent() + bench.wait(FIRST_PROBE_S))
        assert any(isinstance(item, Introduction) for item in answers) is (number == 1)


def test_a_credential_signed_again_is_introduced_from_then_on() -> None:
    bench = Bench()
    (before,) = bench.frames(bench.sent())
    renewed = replace(bench.own.credential, certificate=b"renewed", signature=b"again")
    bench.execute(SetCredential(renewed.encode()))
    (after,) = bench.frames(bench.wait(FIRST_PROBE_S * 1.2))
    assert isinstance(before, Introduction)
    assert isinstance(after, Introduction)
    assert before.credential == OUR_CREDENTIAL
    assert after.credential == renewed
    assert before.probe_id != after.probe_id


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
        path.address.move(path.remote or ELSEWHERE, bench.now)
    introduce(bench, 0)
    assert bench.link.stats.dropped == {"paths_full": 1}
    bench.wait(1.0)


@pytest.mark.audit("sec-1")
def test_a_peer_that_goes_on_to_another_interface_with_each_introduction_begins_few_paths() -> None:
    """Before: each of them began a path, with keys of its own, for 0.3 ms; 3,000 a second took a processor."""
    bench = up()
    began = refused = 0
    for number in range(600):
        interface = InterfaceId(10 + number % 200)
        before = bench.link._paths.get((A, interface))
        introduce(bench, number, interface=interface)
        after = bench.link._paths.get((A, interface))
        began += after is not None and after is not before
        refused += after is None
    assert began == NEW_PATHS
    assert bench.link.stats.dropped["new_paths_too_often"] == refused > 400
    bench.sent()
    bench.wait(1.0 / NEW_PATHS_PER_S)
    introduce(bench, 600, interface=InterfaceId(250))
    assert (A, InterfaceId(250)) in bench.link._paths, "one that it really has is known a little later"


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


@pytest.mark.audit("sec-1")
def test_a_path_that_made_room_and_comes_back_uses_no_packet_number_again() -> None:
    """Its keys are those of the beginning: a number sealed with twice would open both datagrams."""
    bench = up()
    first = InterfaceId(10)
    for interface in range(10, 9 + MAX_PATHS_OF_A_PEER):
        introduce(bench, 0, interface=InterfaceId(interface))
    used: list[bytes] = []
    for number in range(1, 20):
        introduce(bench, number, interface=first)
        used += [
            datagram[:20] for datagram in bench.sent() if frame.decode_header(datagram).receiver_interface == first
        ]
    introduce(bench, 0, interface=InterfaceId(90))
    assert (A, first) not in bench.link._paths, "it made room"
    introduce(bench, 20, interface=first)
    again = [datagram[:20] for datagram in bench.sent() if frame.decode_header(datagram).receiver_interface == first]
    assert len(used) > 10
    assert again
    assert not set(used) & set(again)
