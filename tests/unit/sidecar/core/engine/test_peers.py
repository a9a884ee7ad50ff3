from __future__ import annotations

import dataclasses
import math
from collections import Counter
from dataclasses import replace
from typing import TYPE_CHECKING

import pytest

from lab.simulated.sessions import credential_of, private_key, session_of, with_credential
from plr.protos.base.errors import DecodeError
from plr.protos.model.ids import InterfaceId, InterfaceName, NodeName, Role, ServiceName, SessionId, Version
from plr.protos.model.members import (
    MAX_PEERS,
    NO_POLICY,
    POLICY_PENDING,
    CallPermit,
    Candidate,
    CandidateKind,
    Peer,
    PeerSet,
    RemovalReason,
    RemovedPeer,
)
from plr.protos.trust.identity import EXPIRED, MALFORMED, NOT_YET_VALID, REVOKED, UNTRUSTED, CertificateError
from plr.sidecar.core.crypto.session import OwnSession
from plr.sidecar.core.engine.peers import RESTART_GAP_S, Peers
from plr.sidecar.core.seam.links import PeerRestarted
from tests.support.builders import ECHO, A, B, peer

if TYPE_CHECKING:
    from collections.abc import Callable

    from plr.protos.trust.credential import SessionCredential

OWN = session_of("robot-1", Role.ROBOT, 99)
HELD = peer(A, session=1), peer(B, session=2)


def view(*listed: Peer, removed: tuple[RemovedPeer, ...] = (), policy: int = POLICY_PENDING) -> PeerSet:
    return PeerSet(Version(1), 1, listed, removed, policy)


def known(*listed: Peer) -> Peers:
    peers = Peers(OWN, Counter())
    assert peers.apply(view(*listed), nobody) is None
    return peers


def nobody(_: NodeName) -> bool:
    return False


def everybody(_: NodeName) -> bool:
    return True


def test_a_peer_that_vanished_is_kept_while_a_path_to_it_lives() -> None:
    peers = known(*HELD)
    peers.apply(view(), lambda name: name == A)
    assert peers.names() == [A]
    assert peers.lay_down(A)
    assert A not in peers


def asleep(*listed: Peer, policy: int = POLICY_PENDING) -> Peers:
    """All listed peers vanished from the view, and no path reaches them."""
    peers = Peers(OWN, Counter())
    assert peers.apply(view(*listed, policy=policy), nobody) is None
    assert peers.apply(view(policy=policy), nobody) is None
    assert peers.names() == []
    return peers


def dormant(peers: Peers) -> list[NodeName]:
    return [link_peer.name for link_peer in peers.for_links() if link_peer.dormant]


def test_a_peer_that_vanished_without_a_path_is_dormant_and_wakes() -> None:
    peers = asleep(*HELD)
    assert dormant(peers) == [A, B]
    assert [one.name for one in peers.all_held()] == [A, B]
    assert peers.may_call(A, ECHO), "it may send before it is known that a path to it lives"
    assert peers.session(A) is None
    assert peers.wake(A)
    assert not peers.wake(A)
    assert (peers.names(), dormant(peers), peers.session(A)) == ([A], [B], 1)
    assert peers.is_unlisted(A)
    peers.apply(view(HELD[1]), everybody)
    assert (sorted(peers.names()), dormant(peers)) == ([A, B], [])


@pytest.mark.parametrize("reason", list(RemovalReason))
def test_a_dormant_peer_is_forgotten_for_each_reason_but_an_expired_lease(reason: RemovalReason) -> None:
    peers = asleep(*HELD)
    peers.apply(view(removed=(RemovedPeer(A, reason),)), nobody)
    assert peers.is_dormant(A) is (reason is RemovalReason.LEASE_EXPIRED)
    assert peers.is_dormant(B)


def test_a_dormant_peer_is_forgotten_with_its_policy_or_its_trust() -> None:
    peers = asleep(*HELD, policy=7)
    peers.apply(view(policy=POLICY_PENDING), nobody)
    assert dormant(peers) == [A, B]
    assert peers.all_kept() == {A, B}
    assert not peers.ended_by_policy
    peers.apply(view(removed=(RemovedPeer(B, RemovalReason.LEFT),), policy=8), nobody)
    assert dormant(peers) == []
    assert not peers.all_kept()
    assert peers.ended_by_policy == frozenset({A})
    peers.apply(view(policy=8), nobody)
    assert not peers.ended_by_policy
    own = session_of("robot-1", Role.ROBOT, 99)
    peers = Peers(own, Counter())
    peers.apply(view(*HELD), nobody)
    peers.apply(view(), nobody)
    own.condemn(HELD[0].session)
    assert peers.recheck() == []
    assert dormant(peers) == [B]


def test_a_dormant_peer_may_restart_and_stays_dormant() -> None:
    peers = asleep(*HELD)
    assert not peers.restarted(restart(session=2), 1.0), "that is the session of another dormant peer"
    assert peers.restarted(restart(), 1.0)
    assert [one.session for one in peers.for_links()] == [9, 2]
    assert dormant(peers) == [A, B]
    peers.apply(view(HELD[0]), nobody)
    assert peers.session(A) == 9, "the view is older than what the peer proved"


def test_a_dormant_robot_is_not_asked_but_a_dormant_server_is() -> None:
    robot, server = HELD[0], dataclasses.replace(HELD[1], role=Role.ROBOT)
    server = with_credential(server)
    peers = asleep(robot, server)
    assert [bool(one.addresses) for one in peers.for_links()] == [True, False]


def test_the_peers_and_the_dormant_ones_are_no_more_than_the_limit() -> None:
    peers = asleep(*HELD)
    many = [peer(NodeName(f"n{number}"), session=number + 10) for number in range(MAX_PEERS - 1)]
    peers.apply(view(*many), nobody)
    assert dormant(peers) == [B]
    assert peers._dropped["dormant_full"] == 1


def test_a_listed_peer_survives_the_death_of_its_paths() -> None:
    peers = known(*HELD)
    assert not peers.lay_down(A)
    assert A in peers


def test_a_peer_that_is_listed_again_is_no_longer_on_sufferance() -> None:
    peers = known(*HELD)
    peers.apply(view(), everybody)
    peers.apply(view(HELD[0]), everybody)
    assert not peers.lay_down(A)


def test_one_whose_lease_expired_is_kept_one_that_left_or_was_revoked_goes_at_once() -> None:
    for reason, kept in (
        (RemovalReason.LEASE_EXPIRED, True),
        (RemovalReason.LEFT, False),
        (RemovalReason.REVOKED, False),
        (RemovalReason.FORBIDDEN, False),
    ):
        peers = known(*HELD)
        peers.apply(view(removed=(RemovedPeer(A, reason),)), everybody)
        assert (A in peers) is kept
        assert B in peers


def test_one_that_vanished_goes_when_the_policy_changes() -> None:
    """Nobody said what it may do under the new policy, and its own say-so is worth nothing."""
    for before, after, kept in (
        (7, 7, True),
        (7, 8, False),
        (7, POLICY_PENDING, True),
        (7, NO_POLICY, True),
        (NO_POLICY, 7, False),
        (POLICY_PENDING, 7, False),
    ):
        peers = Peers(OWN, Counter())
        peers.apply(view(*HELD, policy=before), nobody)
        peers.apply(view(HELD[1], policy=after), everybody)
        assert (A in peers) is kept, (before, after)
        assert B in peers


def test_a_policy_that_was_away_for_a_while_is_a_change() -> None:
    """Without a policy a peer was allowed everything, which must not outlive the policy's return."""
    peers = Peers(OWN, Counter())
    for policy in (7, NO_POLICY):
        peers.apply(view(HELD[0], policy=policy), everybody)
    peers.apply(view(policy=POLICY_PENDING), everybody)
    assert A in peers
    peers.apply(view(policy=7), everybody)
    assert A not in peers


def test_only_a_known_robot_may_call_and_only_what_it_was_permitted() -> None:
    peers = known(dataclasses.replace(HELD[0], may_call=CallPermit(frozenset({ECHO}))), HELD[1])
    assert peers.may_call(A, ECHO)
    assert not peers.may_call(A, ServiceName("/other"))
    assert peers.may_call(B, ServiceName("/other"))
    assert not peers.may_call(NodeName("stranger"), ECHO)


def restart(name: NodeName = A, session: int = 9, incarnation: int = 2) -> PeerRestarted:
    return PeerRestarted(name, credential_of(name, Role.CLOUD, session, incarnation), at_home=True)


def test_a_restart_is_believed_when_it_is_newer() -> None:
    peers = known(*HELD)
    assert peers.restarted(restart(), 1.0)
    assert peers.session(A) == 9
    for stale in (restart(session=10, incarnation=2), restart(session=10, incarnation=1)):
        assert not peers.restarted(stale, 99.0)
    assert not peers.restarted(restart(NodeName("stranger")), 1.0)


def test_restarts_are_rate_limited_for_each_peer() -> None:
    peers = known(*HELD)
    assert peers.restarted(restart(), 1.0)
    assert not peers.restarted(restart(session=10, incarnation=3), 1.0 + RESTART_GAP_S / 2)
    assert peers.restarted(restart(B, session=20), 1.0 + RESTART_GAP_S / 2)
    assert peers.restarted(restart(session=10, incarnation=3), 1.0 + RESTART_GAP_S)


def test_a_peer_cannot_take_the_session_of_another() -> None:
    peers = known(*HELD)
    assert not peers.restarted(restart(session=2), 1.0)
    newcomer = peer("cloud-c", session=9)
    assert peers.restarted(restart(session=9), 1.0)
    assert peers.apply(view(*HELD, newcomer), everybody) is None
    assert (peers.session(A), peers.names()) == (9, [A, B])
    why = "it has the session number of cloud-a, which proved that the number is its own"
    assert [(one.peer, one.why) for one in peers.refused.values()] == [(newcomer, why)]
    twins = peer("cloud-d", session=5), peer("cloud-e", session=5)
    assert "share a session" in (peers.apply(view(*HELD, *twins), everybody) or "")


@pytest.mark.parametrize("reaches", [everybody, nobody])
def test_nobody_takes_the_session_of_a_peer_that_the_view_does_not_list(reaches: Callable[[NodeName], bool]) -> None:
    """Without certificates: it is in clear in each datagram, and free in a control plane that lost the peer."""
    peers = known(*HELD)
    thief = peer("cloud-d", session=2)
    assert peers.apply(view(HELD[0], thief), reaches) is None
    assert peers.held_session(B) == 2
    assert list(peers.refused) == [thief.name]
    assert peers._dropped == {"session_taken": 1}
    assert peers.readmit(peers.all_refused()) == []
    peers.apply(view(HELD[0], thief, removed=(RemovedPeer(B, RemovalReason.LEFT),)), reaches)
    assert (peers.names(), peers.held_session(B)) == ([A, thief.name], None), "the number is nobody's any more"


def test_a_peer_in_another_session_leaves_its_earlier_one() -> None:
    peers = known(*HELD)
    other = peer("cloud-d", session=2)
    assert peers.apply(view(HELD[0], peer(B, session=3, incarnation=2), other), nobody) is None
    assert sorted(peers.names()) == [A, B, other.name]


@pytest.mark.audit("sec-4")
def test_one_that_is_refused_takes_no_session_of_a_living_peer() -> None:
    """The control plane restarted; somebody registered with the number of a peer that is only known by its paths."""
    judge = Judge()
    judge.wrong = {B: CertificateError(MALFORMED, "the credential's session number is not that of its key")}
    peers = judge.peers
    assert peers.apply(view(HELD[0]), nobody) is None
    squatter = peer(B, session=1)
    assert peers.apply(view(squatter), everybody) is None
    assert peers.session(A) == 1
    assert peers.names() == [A]
    assert peers.apply(view(HELD[0], squatter), everybody) is None, "not even a view that lists both is refused for it"
    assert peers.names() == [A]


def test_a_view_older_than_the_restart_does_not_bring_the_old_session_back() -> None:
    peers = known(*HELD)
    peers.restarted(restart(), 1.0)
    peers.apply(view(*HELD), everybody)
    assert peers.session(A) == 9
    peers.apply(view(peer(A, session=30, incarnation=3), HELD[1]), everybody)
    assert peers.session(A) == 30


def test_refused_views_change_nothing() -> None:
    peers = known(*HELD)
    assert "share a session" in (peers.apply(view(peer(A, session=5), peer(B, session=5)), everybody) or "")
    many = tuple(peer(f"n{number}", session=number) for number in range(MAX_PEERS + 1))
    assert str(MAX_PEERS) in (peers.apply(view(*many), everybody) or "")
    assert peers.all() == list(HELD)


def test_links_get_each_address_of_an_interface_once() -> None:
    def candidate(number: int, host: str, kind: CandidateKind = CandidateKind.HOST) -> Candidate:
        return Candidate(InterfaceId(number), InterfaceName("eth"), kind, (host, 1))

    reflexive = CandidateKind.SERVER_REFLEXIVE
    subject = Peer(
        A, HELD[0].role, SessionId(1), bytes(16), 1,
        (candidate(1, "b"), candidate(0, "a"), candidate(1, "c"), candidate(1, "b", reflexive)),
    )  # fmt: skip
    (link_peer,) = known(with_credential(subject)).for_links()
    assert link_peer.addresses == ((0, (("a", 1),)), (1, (("b", 1), ("c", 1))))


def test_a_peer_whose_credential_is_bad_is_no_peer_and_one_held_for_its_paths_is_one_no_more() -> None:
    peers = known(*HELD)
    bad = replace(HELD[0], credential=HELD[1].credential)
    assert peers.apply(view(bad, HELD[1]), everybody) is None
    assert peers.names() == [B]
    assert set(peers.refused) == {A}
    assert peers._dropped == {"bad_credential": 1}
    assert [link_peer.name for link_peer in peers.for_links()] == [B]


def test_peers_are_judged_again_when_trust_changes() -> None:
    revoked: set[str] = set()

    def judge(credential: SessionCredential) -> float:
        if credential.name in revoked:
            raise DecodeError("revoked")
        return math.inf

    own = OwnSession(OWN.credential, private_key("robot-1", 99), judge)
    peers = Peers(own, Counter())
    peers.apply(view(*HELD), nobody)
    revoked.add(A)
    assert peers.recheck() == []
    own.forget_admitted()
    assert peers.recheck() == [A]
    assert peers.names() == [B]
    assert peers.refused[A].why == "revoked"


class Judge:
    """Judges credentials by what is `wrong` with them, and counts how often it had to look."""

    def __init__(self) -> None:
        self.wrong: dict[NodeName, DecodeError] = {}
        self.looks = 0
        self.own = OwnSession(OWN.credential, private_key("robot-1", 99), self)
        self.peers = Peers(self.own, Counter())

    def __call__(self, credential: SessionCredential) -> float:
        self.looks += 1
        if (error := self.wrong.get(credential.name)) is not None:
            raise error
        return math.inf


EARLY = CertificateError(NOT_YET_VALID, "not valid for another 99 s")
LATE = CertificateError(EXPIRED, "expired 99 s ago")


def test_refused_peers_are_taken_once_they_are_judged_good() -> None:
    judge = Judge()
    judge.wrong = {A: EARLY, B: CertificateError(UNTRUSTED, "issued by another CA")}
    peers = judge.peers
    assert peers.apply(view(*HELD), nobody) is None
    assert peers.names() == []
    assert peers.all_refused() == list(HELD)
    assert peers.readmit(peers.all_refused()) == []
    del judge.wrong[A]
    judge.own.admit(HELD[0])
    looks = judge.looks
    assert peers.readmit([HELD[0]]) == [A]
    assert judge.looks == looks, "what was judged before the lock was taken is not judged again under it"
    assert [link_peer.name for link_peer in peers.for_links()] == [A]
    assert set(peers.refused) == {B}
    assert not peers.lay_down(A), "the view lists it"


def test_one_dropped_when_trust_changed_comes_back_with_its_trust_unless_the_view_lists_it_no_more() -> None:
    judge = Judge()
    peers = judge.peers
    peers.apply(view(*HELD), nobody)
    peers.apply(view(HELD[0]), everybody)
    judge.wrong = {
        A: CertificateError(UNTRUSTED, "issued by another CA"),
        B: CertificateError(UNTRUSTED, "issued by another CA"),
    }
    judge.own.forget_admitted()
    assert peers.recheck() == [A, B]
    judge.wrong.clear()
    assert peers.readmit(peers.all_refused()) == [A]


@pytest.mark.parametrize("reaches", [everybody, nobody])
def test_a_clock_that_is_wrong_for_a_while_parts_nobody_for_good(reaches: Callable[[NodeName], bool]) -> None:
    """The view would not bring back a peer that it does not list."""
    judge = Judge()
    peers = judge.peers
    peers.apply(view(*HELD), nobody)
    peers.apply(view(HELD[0]), reaches)
    judge.wrong = {B: LATE}
    judge.own.forget_admitted()
    for ended in ([B] if reaches is everybody else [], []):
        assert peers.recheck() == ended
        assert peers.held_session(B) is None
    assert B not in peers.refused, "the view does not name it"
    assert B not in [link_peer.name for link_peer in peers.for_links()]
    assert peers.readmit(peers.all_refused()) == []
    assert not peers.restarted(restart(A, session=2), 1.0), "the session is still its own"
    assert peers.apply(view(HELD[0]), nobody) is None
    judge.wrong.clear()
    assert peers.readmit(peers.all_refused()) == [B]
    assert dormant(peers) == [B]
    assert peers.readmit([HELD[1]]) == []


@pytest.mark.parametrize("error", [CertificateError(REVOKED, "revoked"), DecodeError("it lied")])
@pytest.mark.parametrize("first", [None, LATE])
def test_a_dormant_peer_that_is_bad_whatever_the_clock_is_forgotten(
    error: DecodeError, first: DecodeError | None
) -> None:
    judge = Judge()
    peers = judge.peers
    peers.apply(view(*HELD), nobody)
    peers.apply(view(HELD[0]), nobody)
    for wrong in (first, error):
        judge.wrong = {} if wrong is None else {B: wrong}
        judge.own.forget_admitted()
        peers.recheck()
    judge.wrong.clear()
    assert peers.readmit(peers.all_refused()) == []
    assert peers.all_held() == [HELD[0]]


@pytest.mark.parametrize(
    "newer",
    [view(policy=8), view(removed=(RemovedPeer(B, RemovalReason.REVOKED),)), view(peer(B, session=5, incarnation=2))],
    ids=["another policy", "revoked", "listed"],
)
def test_one_set_aside_is_forgotten_as_a_dormant_peer_is(newer: PeerSet) -> None:
    judge = Judge()
    peers = judge.peers
    peers.apply(view(*HELD), nobody)
    peers.apply(view(), nobody)
    judge.wrong = {B: LATE}
    judge.own.forget_admitted()
    peers.recheck()
    peers.apply(newer, nobody)
    judge.wrong.clear()
    assert HELD[1] not in [*peers.all_refused(), *peers.all_held()]
    assert peers.readmit([HELD[1]]) == []


def test_a_refused_peer_is_not_taken_against_what_became_known_since() -> None:
    judge = Judge()
    judge.wrong = {A: EARLY}
    peers = judge.peers
    peers.apply(view(*HELD), nobody)
    (refused,) = peers.all_refused()
    judge.wrong.clear()
    assert peers.restarted(restart(B, session=1), 1.0)
    assert peers.readmit([refused]) == [], "its session is another's now"
    peers.apply(view(HELD[1]), nobody)
    assert peers.readmit([refused]) == [], "a newer view does not list it"
    assert peers.readmit([peer("stranger", session=7)]) == []
    assert peers.names() == [B]


def test_the_peers_taken_are_no_more_than_the_limit() -> None:
    judge = Judge()
    many = tuple(peer(f"n{number}", session=number + 10) for number in range(MAX_PEERS))
    peers = judge.peers
    peers.apply(view(HELD[0]), nobody)
    judge.wrong = {many[0].name: EARLY}
    peers.apply(view(*many), everybody)
    assert A in peers, "kept for its paths, in the place of the refused one"
    judge.wrong.clear()
    assert peers.readmit(peers.all_refused()) == []
    assert peers.lay_down(A)
    assert peers.readmit(peers.all_refused()) == [many[0].name]
