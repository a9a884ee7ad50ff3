"""What a link remembers of paths that are no more: shares, what goes first, and what is refused from then on."""

from __future__ import annotations

import pytest

from lab.simulated.sessions import session_of
from plr.protos.model.ids import InterfaceId, NodeName, Role, SessionId
from plr.sidecar.core.link import memory as link_memory
from plr.sidecar.core.link.memory import MAX_REMEMBERED_PATHS_OF_PEER, LinkMemory
from plr.sidecar.core.path.key_exchange import DEFAULT_LIMITS
from plr.sidecar.core.path.keys import PathKeys, make_path_keys
from tests.support.builders import peer

pytestmark = pytest.mark.audit("sec-1")

A, B = NodeName("robot-a"), NodeName("robot-b")
REMOTE = InterfaceId(0)


def path_keys(incarnation: int = 1, *, opened: bool = True) -> PathKeys:
    pair = session_of("robot-1", Role.ROBOT, 9).admit(peer(session=1))
    keys = make_path_keys(pair, InterfaceId(0), REMOTE, DEFAULT_LIMITS, 0.0, incarnation, leads=True)
    if opened:
        keys.received.add(3, 0.0)
    return keys


def filled(sessions: range, name: NodeName = A) -> LinkMemory:
    memory = LinkMemory(5)
    for number in sessions:
        memory.keep(name, SessionId(number), REMOTE, path_keys(number))
    return memory


def test_what_is_kept_is_taken_once() -> None:
    memory, keys = LinkMemory(), path_keys()
    memory.keep(A, SessionId(1), REMOTE, keys)
    assert memory.take(B, SessionId(1), REMOTE) is None
    assert memory.take(A, SessionId(1), REMOTE) is keys
    assert memory.take(A, SessionId(1), REMOTE) is None
    assert len(memory) == 0


def test_what_never_opened_anything_is_not_kept() -> None:
    memory = LinkMemory()
    memory.keep(A, SessionId(1), REMOTE, path_keys(opened=False))
    assert len(memory) == 0
    assert not memory.forgot(A, 1)


def test_a_full_share_forgets_the_oldest_session_whatever_the_order_in_which_they_went() -> None:
    memory = LinkMemory()
    for number in [*range(MAX_REMEMBERED_PATHS_OF_PEER, 0, -1), MAX_REMEMBERED_PATHS_OF_PEER + 1]:
        memory.keep(A, SessionId(number), REMOTE, path_keys(number))
    assert len(memory) == MAX_REMEMBERED_PATHS_OF_PEER
    assert memory.take(A, SessionId(1), REMOTE) is None
    assert memory.forgot(A, 1)
    assert not memory.forgot(A, 2)
    assert memory.take(A, SessionId(2), REMOTE) is not None


def test_a_full_share_costs_nobody_else() -> None:
    memory = filled(range(1, 10 * MAX_REMEMBERED_PATHS_OF_PEER))
    kept = path_keys()
    memory.keep(B, SessionId(77), REMOTE, kept)
    for number in range(10 * MAX_REMEMBERED_PATHS_OF_PEER, 20 * MAX_REMEMBERED_PATHS_OF_PEER):
        memory.keep(A, SessionId(number), REMOTE, path_keys(number))
    assert len(memory) == MAX_REMEMBERED_PATHS_OF_PEER + 1
    assert memory.take(B, SessionId(77), REMOTE) is kept
    assert not memory.forgot(B, 1)


def test_beyond_the_total_whoever_has_most_forgets(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(link_memory, "MAX_REMEMBERED_PATHS", 20)
    memory = filled(range(1, 16))
    for number in range(100, 110):
        memory.keep(B, SessionId(number), REMOTE, path_keys(number))
    assert len(memory) == 20
    assert memory.forgot(A, 5)
    assert not memory.forgot(A, 6)
    assert not memory.forgot(B, 100)


def test_names_of_the_forgotten_are_capped(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(link_memory, "MAX_FORGOTTEN_PEERS", 2)
    monkeypatch.setattr(link_memory, "MAX_REMEMBERED_PATHS_OF_PEER", 1)
    memory = LinkMemory()
    for name in ("a", "b", "c"):
        for number in (1, 2):
            memory.keep(NodeName(name), SessionId(number), REMOTE, path_keys(number))
    assert [memory.forgot(NodeName(name), 1) for name in ("a", "b", "c")] == [False, True, True]


def test_the_next_link_inherits_copies_and_what_was_forgotten() -> None:
    memory = filled(range(1, MAX_REMEMBERED_PATHS_OF_PEER + 2))
    heir = LinkMemory()
    heir.keep_all(memory)
    assert heir.forgot(A, 1)
    inherited, original = (one.take(A, SessionId(3), REMOTE) for one in (heir, memory))
    assert inherited is not None
    assert original is not None
    assert inherited.incarnation == original.incarnation == 3
    assert inherited.received is not original.received, "the link before may not have ended"


def test_whoever_has_a_name_after_one_that_was_revoked_starts_over() -> None:
    """A thief may have used, and left behind, the largest incarnations there are."""
    last = 2**64 - 1
    memory = filled(range(last - MAX_REMEMBERED_PATHS_OF_PEER, last + 1))
    memory.begin_era(A, 0)
    assert memory.forgot(A, 1)
    memory.keep(B, SessionId(7), REMOTE, path_keys(7))
    memory.begin_era(A, 1)
    assert not memory.forgot(A, 1)
    assert len(memory) == 1
    memory.keep(A, SessionId(3), REMOTE, path_keys(3))
    memory.begin_era(A, 1)
    heir = LinkMemory()
    heir.keep_all(memory)
    heir.begin_era(A, 1)
    assert heir.take(A, SessionId(3), REMOTE) is not None
