"""The STUN client in simulated time: RFC 8489's schedule, failover, refresh, servers that come and go."""

from __future__ import annotations

import random
from collections import Counter
from itertools import pairwise

import pytest

from plr.sidecar.core.stun.client import MAX_SERVERS_PER_FAMILY, StunClient
from plr.sidecar.core.stun.events import Failed, Mapped, MappingChanged, StunEvent
from plr.sidecar.core.stun.family import MAX_QUEUED_EVENTS, StunClientConfig
from plr.sidecar.core.stun.transaction import Retransmission
from tests.unit.sidecar.stun_network import (
    C6,
    MOVED,
    OUTSIDE,
    OUTSIDE6,
    A,
    Address,
    B,
    Network,
    make,
    reply,
    start,
)


def test_the_address_the_server_saw_is_told_once() -> None:
    net = Network(make(A), {A: OUTSIDE})
    assert net.run(60) == [Mapped(4, OUTSIDE, A)]
    assert net.client.mapping(4) == OUTSIDE
    assert net.client.mapping(6) is None


def test_families_are_learnt_independently() -> None:
    net = Network(make(A, C6), {C6: OUTSIDE6})
    assert net.run(50) == [Mapped(6, OUTSIDE6, C6), Failed(4, "no answer from 192.0.2.1:3478", None)]


def test_requests_follow_the_schedule_of_rfc_8489() -> None:
    net = Network(make(A), {})
    assert net.run(39.4) == []
    assert net.times_sent_to(A) == [0.0, 0.5, 1.5, 3.5, 7.5, 15.5, 31.5]
    assert len({data for _, data, _ in net.sent}) == 1, "a retransmission is the same request"
    assert net.run(0.2) == [Failed(4, "no answer from 192.0.2.1:3478", None)]


def test_the_schedule_is_configurable() -> None:
    quick = StunClientConfig(Retransmission(initial_rto_s=0.1, max_requests=3, last_wait_factor=2))
    net = Network(make(A, config=quick), {})
    net.run(0.45)
    assert net.times_sent_to(A) == [0.0, 0.1, 0.3]
    assert net.run(0.1) == [Failed(4, "no answer from 192.0.2.1:3478", None)]


def test_a_pause_of_the_process_causes_no_burst() -> None:
    client = make(A)
    start(client)
    client.handle_timer(3600.0)
    assert len(client.datagrams_to_send()) == 1


def test_a_failed_round_is_repeated_for_ever_with_backoff_and_jitter() -> None:
    quick = StunClientConfig(Retransmission(0.1, 1, 1), retry_s=1, max_retry_s=8, jitter=0.25)
    net = Network(make(A, config=quick), {})
    events = net.run(3600)
    assert events
    assert all(isinstance(event, Failed) for event in events)
    waits = [later - earlier - 0.1 for earlier, later in pairwise(net.times_sent_to(A))]
    for wait, nominal in zip(waits, [1, 2, 4, 8, 8, 8], strict=False):
        assert 0.75 * nominal <= wait <= 1.25 * nominal
    assert len(waits) > 300
    assert max(waits) <= 10
    assert len({round(wait, 3) for wait in waits[10:20]}) > 5, "the waits vary"


def test_a_server_that_comes_back_is_found_and_the_backoff_forgotten() -> None:
    net = Network(make(A), {})
    net.run(600)
    net.answers[A] = OUTSIDE
    assert net.run(80) == [Mapped(4, OUTSIDE, A)]
    net.answers.clear()
    net.run(80)
    assert net.events[-1][1] == Failed(4, "no answer from 192.0.2.1:3478", OUTSIDE)
    failed_at = net.events[-1][0]
    after = [when for when, _, _ in net.sent if when > failed_at]
    assert after
    assert after[0] - failed_at <= 1.25


def test_a_mapping_is_refreshed_every_15_s_give_or_take_a_quarter() -> None:
    net = Network(make(A), {A: OUTSIDE})
    net.run(600)
    waits = [later - earlier for earlier, later in pairwise(net.times_sent_to(A))]
    assert min(waits) >= 0.75 * 15
    assert max(waits) <= 1.25 * 15 + 0.06
    assert len(waits) > 30
    assert len({data for _, data, _ in net.sent}) == len(net.sent), "each refresh is a new transaction"


def test_a_rebinding_nat_is_noticed() -> None:
    net = Network(make(A), {A: OUTSIDE})
    net.run(5)
    net.answers[A] = MOVED
    assert net.run(25) == [MappingChanged(4, MOVED, OUTSIDE, A)]
    assert net.client.mapping(4) == MOVED


def test_a_mapping_that_changed_while_the_server_was_away_is_told_as_a_change() -> None:
    net = Network(make(A), {A: OUTSIDE})
    net.run(5)
    net.answers.clear()
    assert net.run(70)[0] == Failed(4, "no answer from 192.0.2.1:3478", OUTSIDE)
    net.answers[A] = MOVED
    assert net.run(80) == [MappingChanged(4, MOVED, OUTSIDE, A)]


def test_a_mapping_that_held_while_the_server_was_away_is_told_again() -> None:
    net = Network(make(A), {A: OUTSIDE})
    net.run(5)
    net.answers.clear()
    net.run(70)
    net.answers[A] = OUTSIDE
    assert net.run(80) == [Mapped(4, OUTSIDE, A)]


def test_a_silent_server_costs_the_stagger_and_not_its_whole_schedule() -> None:
    net = Network(make(A, B), {B: OUTSIDE})
    assert net.run(2.2) == [Mapped(4, OUTSIDE, B)]
    assert net.times_sent_to(A) == [0.0, 0.5, 1.5]
    assert net.times_sent_to(B) == [2.0]
    net.run(60)
    assert len(net.times_sent_to(A)) == 3, "the server that answered is asked first from then on"


def test_a_slow_first_server_may_still_win() -> None:
    net = Network(make(A, B), {A: OUTSIDE}, delay_s=3.0)
    assert net.run(3.5) == [Mapped(4, OUTSIDE, A)]


def test_failure_is_told_once_all_servers_have_had_their_schedule() -> None:
    net = Network(make(A, B), {})
    assert net.run(41.4) == []
    assert net.run(0.2) == [Failed(4, "no answer from 192.0.2.2:3478", None)]


def test_a_restart_asks_at_once_and_keeps_the_mapping() -> None:
    net = Network(make(A), {A: OUTSIDE})
    net.run(1)
    net.client.start(net.now)
    assert net.client.mapping(4) == OUTSIDE
    ((request, _),) = net.client.datagrams_to_send()
    net.client.receive_datagram(reply(request, MOVED), A, net.now)
    assert net.client.next_event() == MappingChanged(4, MOVED, OUTSIDE, A)


def test_a_restart_tells_the_mapping_again_where_it_is_the_same() -> None:
    # The driver may have forgotten it: the interface's addresses changed.
    net = Network(make(A), {A: OUTSIDE})
    net.run(1)
    net.client.start(net.now)
    assert net.run(40) == [Mapped(4, OUTSIDE, A)]


def test_drops_are_counted_where_the_driver_wants_them() -> None:
    drops = Counter({"malformed": 2})
    client = StunClient([A], random.Random(1), drops=drops)
    request = start(client)
    client.receive_datagram(request, A, 0.1)
    assert drops == {"malformed": 2, "stun_not_a_response": 1}


def test_new_servers_are_asked_and_old_ones_no_more() -> None:
    net = Network(make(A, C6), {A: OUTSIDE, B: OUTSIDE, C6: OUTSIDE6})
    net.run(1)
    net.client.set_servers([B, C6], net.now)
    net.run(60)
    assert net.times_sent_to(A) == [0.0]
    assert net.times_sent_to(B)[0] == 1.0
    assert 1.0 not in net.times_sent_to(C6), "a family whose servers stay is not disturbed"
    net.client.set_servers([], net.now)
    assert net.client.next_timer() is None


def test_the_table_of_servers_is_capped() -> None:
    servers = [(f"192.0.2.{n}", 3478) for n in range(1, MAX_SERVERS_PER_FAMILY + 4)]
    client = make(*servers, servers[0])
    assert client.servers_ignored == 3
    net = Network(client, {})
    net.run(300)
    assert {server for _, _, server in net.sent} == set(servers[:MAX_SERVERS_PER_FAMILY])


def test_events_that_nobody_fetches_are_capped() -> None:
    client = make(A, config=StunClientConfig(Retransmission(0.1, 1, 1), retry_s=1, max_retry_s=1))
    client.start(0.0)
    while client.events_lost < 3:
        now = client.next_timer()
        assert now is not None
        client.handle_timer(now)
        client.datagrams_to_send()
    fetched = 0
    while client.next_event() is not None:
        fetched += 1
    assert fetched == MAX_QUEUED_EVENTS


def test_nothing_happens_before_the_start_or_without_servers() -> None:
    assert make(A).next_timer() is None
    assert make(A).datagrams_to_send() == []
    empty = make()
    empty.start(0.0)
    assert empty.next_timer() is None
    assert empty.next_event() is None


def test_a_host_name_is_a_mistake_of_the_caller() -> None:
    with pytest.raises(ValueError, match="example"):
        make(("stun.example.org", 3478))


@pytest.mark.parametrize(
    "wrong",
    [
        {"refresh_s": 0.0},
        {"stagger_s": -1.0},
        {"retry_s": 2.0, "max_retry_s": 1.0},
        {"jitter": 1.0},
    ],
)
def test_senseless_timing_is_refused(wrong: dict[str, float]) -> None:
    with pytest.raises(ValueError, match="STUN"):
        StunClientConfig(**wrong)  # type: ignore[arg-type]  # passed through


@pytest.mark.parametrize("wrong", [(0.0, 7, 16.0), (0.5, 0, 16.0), (0.5, 7, 0.0)])
def test_a_senseless_schedule_is_refused(wrong: tuple[float, int, float]) -> None:
    with pytest.raises(ValueError, match="retransmission"):
        Retransmission(*wrong)


def test_the_same_seed_gives_the_same_requests() -> None:
    assert start(make(A, seed=7)) == start(make(A, seed=7))
    assert start(make(A, seed=7)) != start(make(A, seed=8))
    StunClient([A], random.SystemRandom()).start(0.0)


@pytest.mark.parametrize("seed", range(20))
def test_a_lossy_duplicating_reordering_network_still_leads_to_the_mapping(seed: int) -> None:
    rng = random.Random(seed)
    client = make(A, B, seed=seed)
    client.start(0.0)
    now, arriving, events = 0.0, list[tuple[float, bytes, Address]](), list[StunEvent]()
    while now < 300:
        for data, server in client.datagrams_to_send():
            for _ in range(rng.choice([0, 0, 1, 2])):
                arriving.append((now + rng.uniform(0.01, 4.0), reply(data, OUTSIDE), server))
        timer = client.next_timer()
        assert timer is not None
        now = min(timer, *(a[0] for a in arriving)) if arriving else timer
        for arrival in [a for a in arriving if a[0] <= now]:
            arriving.remove(arrival)
            client.receive_datagram(arrival[1], arrival[2], now)
        client.handle_timer(now)
        while (event := client.next_event()) is not None:
            events.append(event)
    assert Mapped in {type(event) for event in events}
    assert client.mapping(4) == OUTSIDE
    assert not any(isinstance(event, MappingChanged) for event in events)
