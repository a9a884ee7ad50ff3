"""Sets of peers put together from changes and from several messages; what is no set is refused."""

from __future__ import annotations

import random
from typing import Any

import pytest

from plr.protos.model.ids import NodeName, Role, SessionId, Version
from plr.protos.model.members import MAX_PEERS, Peer, PeerSet, RemovalReason, RemovedPeer
from plr.sidecar.core.control.peer_assembly import PeerAssembly

SEEDS = range(200)


def peer(name: str, incarnation: int = 1) -> Peer:
    return Peer(NodeName(name), Role.CLOUD, SessionId(1), bytes(16), incarnation)


def gone(name: str) -> RemovedPeer:
    return RemovedPeer(NodeName(name), RemovalReason.LEFT)


def names(peer_set: PeerSet | str | None) -> set[str]:
    assert isinstance(peer_set, PeerSet)
    return {one.name for one in peer_set.peers}


def test_changes_are_put_upon_the_set_in_force() -> None:
    assembly = PeerAssembly(PeerSet(Version(5), 1, (peer("a"), peer("b"))))
    changes = PeerSet(Version(6), 2, (peer("b", 2), peer("c")), (gone("a"),), 9, Version(5))
    whole = assembly.whole(changes)
    assert names(whole) == {"b", "c"}
    assert whole == PeerSet(Version(6), 2, (peer("b", 2), peer("c")), (gone("a"),), 9)
    # Not in force yet: what comes next may be upon the one before.
    assert "version 5 is in force" in str(assembly.whole(PeerSet(Version(7), 3, (), (), 9, Version(6))))
    assert isinstance(whole, PeerSet)
    assembly.in_force(whole)
    assert names(assembly.whole(PeerSet(Version(7), 3, (), (gone("c"),), 9, Version(6)))) == {"b"}


def test_nothing_known_takes_whole_sets_only() -> None:
    assembly = PeerAssembly(None)
    assert isinstance(assembly.whole(PeerSet(Version(7), 3, base=Version(6))), str)
    assert names(assembly.whole(PeerSet(Version(7), 3, (peer("a"),)))) == {"a"}


def test_a_set_in_several_messages_is_one_set() -> None:
    assembly = PeerAssembly(None)
    assert assembly.take(PeerSet(Version(1), 1, (peer("a"),), (gone("z"),), more=True)) is None
    assert assembly.take(PeerSet(Version(1), 1, (peer("b"),), more=True)) is None
    said = assembly.take(PeerSet(Version(1), 1, (peer("c"),)))
    assert said is not None
    assert names(assembly.whole(said)) == {"a", "b", "c"}
    assert said.removed == (gone("z"),)


@pytest.mark.parametrize("other", [(2, 1, 0), (1, 2, 0), (1, 1, 3)])
def test_another_set_in_between_takes_the_place_of_what_was_begun(other: tuple[int, int, int]) -> None:
    version, nonce, base = other
    assembly = PeerAssembly(None)
    assert assembly.take(PeerSet(Version(1), 1, (peer("a"),), more=True)) is None
    said = assembly.take(PeerSet(Version(version), nonce, (peer("b"),), base=Version(base)))
    assert said is not None
    assert names(said) == {"b"}


def test_a_stream_that_ends_takes_what_was_begun_with_it() -> None:
    assembly = PeerAssembly(None)
    assembly.take(PeerSet(Version(1), 1, (peer("a"),), more=True))
    assembly.begin_stream()
    said = assembly.take(PeerSet(Version(1), 1, (peer("b"),)))
    assert said is not None
    assert names(said) == {"b"}


def test_the_rest_of_a_set_that_could_not_be_read_is_no_set() -> None:
    assembly = PeerAssembly(None)
    assembly.take(PeerSet(Version(1), 1, (peer("a"),), more=True))
    assembly.leave_out(1)
    assert assembly.take(PeerSet(Version(1), 1, (peer("b"),), more=True)) is None
    assert assembly.take(PeerSet(Version(1), 1, (peer("c"),))) is None
    assert assembly.take(PeerSet(Version(2), 2, (peer("d"),))) is not None


def test_too_many_are_refused_and_not_kept() -> None:
    assembly = PeerAssembly(None)
    half = tuple(peer(f"n{number}") for number in range(MAX_PEERS // 2 + 1))
    assert assembly.take(PeerSet(Version(1), 1, half, more=True)) is None
    said = assembly.take(PeerSet(Version(1), 1, half, more=True))
    assert said is not None
    assert str(MAX_PEERS) in str(assembly.whole(said))
    assert assembly._begun is None
    assert assembly.take(PeerSet(Version(1), 1, half)) is None
    # Nor by changes upon a full set.
    full = PeerSet(Version(2), 2, tuple(peer(f"n{number}") for number in range(MAX_PEERS)))
    assembly.in_force(full)
    assert str(MAX_PEERS) in str(assembly.whole(PeerSet(Version(3), 3, (peer("more"),), base=Version(2))))


@pytest.mark.audit("ops-17")
@pytest.mark.parametrize("base", [0, 5])
@pytest.mark.parametrize(
    ("first", "then"),
    [
        (((peer("a"),), ()), ((peer("a", 2),), ())),
        (((peer("a"),), ()), ((), (gone("a"),))),
        (((), (gone("a"),)), ((peer("a"),), ())),
        (((), (gone("a"),)), ((), (gone("a"),))),
    ],
)
def test_who_is_named_twice_in_one_set_makes_it_none_and_what_is_held_stays(
    base: int, first: tuple[tuple[Peer, ...], tuple[RemovedPeer, ...]], then: tuple[Any, Any]
) -> None:
    assembly = PeerAssembly(PeerSet(Version(5), 1, (peer("a"), peer("b"))))
    assembly.take(PeerSet(Version(6), 2, *first, base=Version(base), more=True))
    said = assembly.take(PeerSet(Version(6), 2, *then, base=Version(base)))
    assert said is not None
    assert assembly.whole(said) == "a appears twice in it"
    assert assembly.is_upon(said)
    after = PeerSet(Version(7), 3, (peer("c"),), base=Version(5))
    assert names(assembly.whole(after)) == {"a", "b", "c"}


def test_whatever_comes_what_is_kept_is_bounded() -> None:
    for seed in SEEDS:
        rng = random.Random(seed)
        assembly = PeerAssembly(None)
        for _ in range(50):
            message = PeerSet(
                Version(rng.randrange(4)),
                rng.randrange(3),
                tuple(peer(f"n{rng.randrange(9)}") for _ in range(rng.randrange(4))),
                (),
                0,
                Version(rng.randrange(4)),
                more=rng.random() < 0.5,
            )
            said = assembly.take(message)
            if said is not None:
                assert not said.more
                whole = assembly.whole(said)
                if isinstance(whole, PeerSet):
                    assert whole.base == 0
                    assembly.in_force(whole)
