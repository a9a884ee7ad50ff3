from __future__ import annotations

from collections import Counter

from plr.protos.model.ids import NodeName, Version
from plr.protos.model.members import Peer, PeerSet, RemovalReason, RemovedPeer
from plr.sidecar.core.engine.removals import MAX_REMOVALS, WHY_REMOVED, Removal, Removals
from tests.support.builders import A, B, peer

EXPIRED, REVOKED = RemovalReason.LEASE_EXPIRED, RemovalReason.REVOKED


def view(*listed: Peer, **removed: RemovalReason) -> PeerSet:
    notices = tuple(RemovedPeer(NodeName(name.replace("_", "-")), reason) for name, reason in removed.items())
    return PeerSet(Version(1), 1, listed, notices)


def test_a_removal_keeps_its_reason_and_time_until_the_view_lists_the_peer_again() -> None:
    removals = Removals(Counter())
    removals.follow(view(cloud_a=EXPIRED), [A, B], 5.0)
    removals.follow(view(cloud_a=EXPIRED), [A], 9.0)
    assert dict(removals.latest()) == {A: Removal(EXPIRED, 5.0), B: Removal(None, 5.0)}
    removals.follow(view(peer(A)), [A], 10.0)
    assert removals.latest() == [(B, Removal(None, 5.0))]


def test_a_later_and_graver_reason_counts() -> None:
    removals = Removals(Counter())
    removals.follow(view(cloud_a=EXPIRED), [A, B], 5.0)
    removals.follow(view(cloud_a=REVOKED), [], 7.0)
    assert removals.latest()[:1] == [(A, Removal(REVOKED, 7.0))]


def test_an_expired_lease_is_no_later_news_than_another_reason() -> None:
    removals = Removals(Counter())
    removals.follow(view(cloud_a=REVOKED), [A, B], 5.0)
    removals.follow(view(cloud_a=EXPIRED, cloud_b=EXPIRED), [], 7.0)
    assert dict(removals.latest()) == {A: Removal(REVOKED, 5.0), B: Removal(EXPIRED, 7.0)}


def test_another_policy_is_the_reason_for_which_a_kept_peer_ends() -> None:
    removals = Removals(Counter())
    removals.follow(view(cloud_a=EXPIRED), [A, B], 5.0, kept={A, B})
    removals.follow(view(cloud_a=EXPIRED), [A, B], 7.0, ended_by_policy={A, B})
    removals.follow(view(cloud_a=EXPIRED), [], 9.0)
    assert removals.latest() == [(name, Removal(RemovalReason.FORBIDDEN, 7.0)) for name in (B, A)]


def test_those_that_are_kept_are_remembered_however_many() -> None:
    dropped: Counter[str] = Counter()
    removals = Removals(dropped)
    kept = {NodeName(f"n{number}") for number in range(MAX_REMOVALS + 3)}
    removals.follow(view(), sorted(kept), 1.0, kept=kept)
    gone = [NodeName(f"gone{number}") for number in range(MAX_REMOVALS + 2)]
    removals.follow(view(), gone, 2.0, kept=kept)
    assert {name for name, _ in removals.latest()} == {*kept, *gone[2:]}
    assert dropped == {"removal_forgotten": 2}
    removals.follow(view(), [A], 3.0, kept=kept - {NodeName("n0")})
    assert NodeName("n0") not in dict(removals.latest()), "it is the one removed first"


def test_nobody_is_remembered_who_was_no_peer() -> None:
    removals = Removals(Counter())
    removals.follow(view(stranger=REVOKED), [A], 5.0)
    assert [name for name, _ in removals.latest()] == [A]


def test_the_one_removed_first_is_forgotten() -> None:
    dropped: Counter[str] = Counter()
    removals = Removals(dropped)
    for number in range(MAX_REMOVALS + 3):
        removals.follow(view(), [NodeName(f"n{number}")], float(number))
    assert len(removals.latest()) == MAX_REMOVALS
    assert removals.latest()[0][0] == f"n{MAX_REMOVALS + 2}"
    assert dropped == {"removal_forgotten": 3}


def test_each_reason_has_words() -> None:
    assert WHY_REMOVED.keys() == set(RemovalReason)


def test_a_removal_keeps_the_time_since_when_the_peer_is_dormant() -> None:
    removals = Removals(Counter())
    removals.follow(view(), [A], 5.0)
    removals.note_dormant([A, B], 6.0)
    assert removals.latest() == [(A, Removal(None, 5.0, 6.0))]
    removals.follow(view(cloud_a=EXPIRED), [], 7.0)
    assert removals.latest() == [(A, Removal(EXPIRED, 7.0, 6.0))]
    removals.note_dormant([A], 8.0)
    assert removals.latest() == [(A, Removal(EXPIRED, 7.0, 8.0))]
