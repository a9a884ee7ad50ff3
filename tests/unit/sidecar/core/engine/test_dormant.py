from __future__ import annotations

from collections import Counter

import pytest

from lab.simulated.sessions import session_of
from plr.protos.model.ids import NodeName, Role
from plr.protos.model.members import MAX_PEERS
from plr.sidecar.core.engine.dormant import MAX_DORMANT_SERVERS, Dormant, DormantPeers
from tests.support.builders import peer

OWN = session_of("robot-1", Role.ROBOT, 99)


def dormant(number: int, session: int | None = None) -> Dormant:
    one = peer(NodeName(f"n{number}"), session=session or number + 1)
    return Dormant(one, OWN.admit(one))


def names(table: DormantPeers) -> list[str]:
    return [one.peer.name for one in table.all()]


@pytest.mark.parametrize(
    ("role", "awake", "kept"),
    [
        (Role.ROBOT, 0, MAX_DORMANT_SERVERS),
        (Role.ROBOT, MAX_PEERS - 3, 3),
        (Role.CLOUD, MAX_PEERS - 70, 70),
        (Role.CLOUD, MAX_PEERS, 0),
    ],
)
def test_those_dormant_for_longest_make_room(role: Role, awake: int, kept: int) -> None:
    dropped: Counter[str] = Counter()
    table = DormantPeers(role, dropped)
    for number in range(80):
        table.put(dormant(number))
        table.make_room(awake)
    assert names(table) == [f"n{number}" for number in range(80 - kept, 80)]
    assert dropped == {"dormant_full": 80 - kept}


def test_those_set_aside_are_no_more_than_may_be_dormant() -> None:
    dropped: Counter[str] = Counter()
    table = DormantPeers(Role.ROBOT, dropped)
    for number in range(MAX_DORMANT_SERVERS + 2):
        table.set_aside(dormant(number).peer)
    first, *_ = table.aside()
    assert (first.name, len(table.aside())) == ("n2", MAX_DORMANT_SERVERS)
    assert dropped == {"dormant_full": 2}
    assert table.has_session(first.session)
    assert not table.all()
    assert table.take_aside(first)
    assert not table.take_aside(first)


def test_who_was_forgotten_is_told_once() -> None:
    table = DormantPeers(Role.CLOUD, Counter())
    for number in (1, 2, 3):
        table.put(dormant(number))
    table.drop(lambda one: one.name == "n1")
    table.make_room(MAX_PEERS - 1)
    assert table.take_forgotten() == {"n1": 2, "n2": 3}
    assert not table.take_forgotten()


def test_a_peer_has_one_entry_which_keeps_its_place() -> None:
    table = DormantPeers(Role.CLOUD, Counter())
    for number in (1, 2):
        table.put(dormant(number))
    table.put(dormant(1, session=9))
    assert names(table) == ["n1", "n2"]
    assert table.has_session(dormant(9, session=9).peer.session)
    assert not table.has_session(dormant(1).peer.session)
    taken = table.take(NodeName("n1"))
    assert taken is not None
    assert taken.peer.session == 9
    assert table.take(NodeName("n1")) is None
