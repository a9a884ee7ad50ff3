"""Answers to clients that are not wholly discovered: kept in order, tried again, given up in the end."""

from __future__ import annotations

import itertools
import random

from plr.sidecar.ros.robot.new_clients import GIVE_UP_S, MAX_KEPT_ANSWERS, MAX_RETRY_S, REST_S, NewClients


def test_answers_stay_in_order_and_go_when_the_client_is_known() -> None:
    subject: NewClients[int] = NewClients()
    assert subject.next_due() is None
    assert not subject.waits(b"a")
    assert all(subject.keep(b"a", number, 100.0) for number in range(3))
    assert subject.waits(b"a")
    due = subject.next_due()
    assert due is not None
    assert subject.take_due(due - 0.001) is None
    assert subject.take_due(due) == (b"a", 0)
    assert subject.unknown(b"a", due) == []
    later = subject.next_due()
    assert later is not None
    assert later > due
    assert subject.take_due(later) == (b"a", 0)
    assert subject.known(b"a") == [1, 2]
    assert not subject.waits(b"a")
    assert subject.kept == 0
    assert subject.next_due() is None


def test_a_client_that_never_comes_is_given_up_and_costs_little() -> None:
    subject: NewClients[int] = NewClients()
    subject.keep(b"a", 1, 100.0)
    subject.keep(b"a", 2, 105.0)
    tries, given_up = 0, []
    while (due := subject.next_due()) is not None:
        assert subject.take_due(due) is not None
        tries += 1
        given_up += subject.unknown(b"a", due)
        now = due
    assert given_up == [1, 2]
    assert 100.0 + GIVE_UP_S <= now <= 100.0 + GIVE_UP_S + MAX_RETRY_S
    assert tries < 16
    assert subject.kept == 0


def test_many_clients_take_turns_with_a_rest_between() -> None:
    rng, subject, now = random.Random(1), NewClients[bytes](), 100.0
    clients = [bytes([number]) for number in range(20)]
    for client in clients:
        subject.keep(client, client, now)
    tried: list[tuple[float, bytes]] = []
    known = set()
    while (due := subject.next_due()) is not None:
        now = max(now, due)
        taken = subject.take_due(now)
        assert taken is not None
        client, _ = taken
        tried.append((now, client))
        if rng.random() < 0.3:
            known.add(client)
            assert subject.known(client) == []
        else:
            subject.unknown(client, now)
    failed = [at for at, _ in tried]
    assert all(later - at >= REST_S - 1e-9 or later == at for at, later in itertools.pairwise(failed))
    assert {client for _, client in tried} == set(clients)


def test_what_is_kept_is_bounded() -> None:
    subject: NewClients[int] = NewClients()
    assert all(subject.keep(b"a", number, 100.0) for number in range(MAX_KEPT_ANSWERS))
    assert not subject.keep(b"b", 0, 100.0)
