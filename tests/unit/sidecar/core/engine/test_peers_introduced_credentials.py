"""Credentials that come in introductions: how often they are looked at, and renewals without the control plane."""

from __future__ import annotations

import math
import random
import statistics
from collections import Counter
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import pytest

from lab.simulated.sessions import credential_of, private_key
from plr.protos.base.errors import DecodeError
from plr.protos.model.ids import NodeName, Role, SessionId, Version
from plr.protos.model.members import POLICY_PENDING, PeerSet
from plr.protos.trust.credential import decode_credential
from plr.sidecar.core.crypto.session import OwnSession
from plr.sidecar.core.engine.peers import Peers
from plr.sidecar.core.engine.verification_budget import ALL_LOOKS_AT_ONCE, ALL_LOOKS_PER_S, LOOKS_AT_ONCE, LOOKS_PER_S
from plr.sidecar.core.seam.links import PeerRenewed, PeerRestarted
from tests.support.builders import A, B, peer

if TYPE_CHECKING:
    from collections.abc import Callable

    from plr.protos.model.members import Peer
    from plr.protos.trust.credential import SessionCredential

HELD = peer(A, session=1), peer(B, session=2)
FORGED, GENUINE = 9, 2
"""Incarnations."""


def peers_judged_by(judge: Callable[[SessionCredential], float], *held: Peer) -> Peers:
    own = OwnSession(credential_of("robot-1", Role.ROBOT, 99), private_key("robot-1", 99), judge)
    peers = Peers(own, Counter())
    assert peers.apply(PeerSet(Version(1), 1, held or HELD, (), POLICY_PENDING), lambda name: False) is None
    return peers


def view_again(peers: Peers, *listed: Peer) -> None:
    assert peers.apply(PeerSet(Version(2), 2, listed, (), POLICY_PENDING), lambda name: False) is None


class Suspicious:
    """Believes no credential of the forger's incarnation, and counts how often it looked at one."""

    def __init__(self) -> None:
        self.looks = 0

    def __call__(self, credential: SessionCredential) -> float:
        if credential.incarnation == FORGED:
            self.looks += 1
            raise DecodeError("forged")
        return math.inf


def restart(name: NodeName, session: int, incarnation: int, *, at_home: bool = True) -> PeerRestarted:
    return PeerRestarted(name, credential_of(name, Role.CLOUD, session, incarnation), at_home)


@pytest.mark.audit("sec-8")
def test_forged_restarts_do_not_keep_a_genuine_one_out() -> None:
    """Before: never taken within an hour, since whoever came first had the second's only look."""
    rng, taken = random.Random(1), []
    for _ in range(20):
        judge = Suspicious()
        peers = peers_judged_by(judge)
        now = genuine_at = 0.0
        forged = 0
        while True:
            now += rng.expovariate(100.0)
            forged += 1
            assert not peers.restarted(restart(A, 300 + forged, FORGED), now)
            if now >= genuine_at:
                genuine_at = now + rng.uniform(0.2, 0.3)
                if peers.restarted(restart(A, 200, GENUINE), now):
                    break
        taken.append(now)
        assert judge.looks <= LOOKS_AT_ONCE + LOOKS_PER_S * now + 1
        assert peers.session(A) == 200
    assert statistics.median(taken) < 5
    assert max(taken) < 30


@pytest.mark.audit("sec-8")
def test_forgeries_from_elsewhere_hold_nothing_up() -> None:
    peers = peers_judged_by(Suspicious())
    for number in range(10_000):
        assert not peers.restarted(restart(A, 300 + number, FORGED, at_home=False), 1.0 + number * 1e-3)
    assert peers._dropped["verifications_full"] > 9_000
    assert peers.restarted(restart(A, 200, GENUINE), 11.0)


@pytest.mark.audit("sec-8")
def test_the_looks_of_all_peers_together_are_bounded_and_forgotten_with_them() -> None:
    judge = Suspicious()
    many = [peer(NodeName(f"cloud-{number}"), session=number + 1) for number in range(500)]
    peers = peers_judged_by(judge, *many)
    for step in range(1000):
        for one in many[::7]:
            peers.restarted(restart(one.name, 10_000 + step, FORGED), step * 0.01)
    assert judge.looks <= ALL_LOOKS_AT_ONCE + 10 * ALL_LOOKS_PER_S + 1
    view_again(peers, many[0])
    assert len(peers._budget._of_peer) > 2, "who leaves and comes back at once gets no new looks by it"
    peers.restarted(restart(many[0].name, 20_000, FORGED), 20.0)
    view_again(peers, many[0])
    assert len(peers._budget._of_peer) <= 2


ENDS_AT = {b"": 10.0, b"newer": 20.0, b"older": 5.0}


def judged_by_certificate() -> Peers:
    def judge(credential: SessionCredential) -> float:
        if credential.certificate not in ENDS_AT:
            raise DecodeError("forged")
        return ENDS_AT[credential.certificate]

    return peers_judged_by(judge)


def renewal(certificate: bytes = b"newer", **changes: Any) -> PeerRenewed:
    credential = replace(decode_credential(HELD[0].credential), certificate=certificate, **changes)
    return PeerRenewed(A, credential, at_home=True)


@pytest.mark.audit("sec-6")
def test_a_certificate_renewed_without_the_control_plane_is_taken_and_an_older_view_does_not_undo_it() -> None:
    peers = judged_by_certificate()
    keys = peers._keys[A]
    assert peers.renewed(renewal(), 1.0)
    renewed = replace(HELD[0], credential=renewal().credential.encode())
    assert peers.get(A) == renewed
    assert peers._keys[A] == keys
    assert not peers.renewed(renewal(), 1.0), "no news"
    view_again(peers, *HELD)
    assert peers.get(A) == renewed
    newest = replace(HELD[0], candidates=())
    view_again(peers, newest)
    assert peers.get(A) == replace(newest, credential=renewed.credential)


@pytest.mark.audit("sec-6")
@pytest.mark.parametrize(
    "event",
    [
        renewal(b"older"),
        renewal(b"forged"),
        renewal(session=SessionId(77)),
        renewal(incarnation=2),
        renewal(public_key=credential_of("x", Role.CLOUD, 5).public_key),
        replace(renewal(), peer=NodeName("stranger")),
    ],
    ids=["ends before", "forged", "another session", "another run", "another key", "a stranger"],
)
def test_what_is_no_renewal_changes_nothing(event: PeerRenewed) -> None:
    peers = judged_by_certificate()
    before = peers.for_links()
    assert not peers.renewed(event, 1.0)
    assert peers.get(A) == HELD[0]
    assert peers.for_links() == before
