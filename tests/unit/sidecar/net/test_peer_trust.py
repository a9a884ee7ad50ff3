"""Trust in peers, where the real drivers join two data planes."""

from __future__ import annotations

import itertools
import logging
import math
from dataclasses import replace
from typing import TYPE_CHECKING

import pytest

from plr.protos.base.errors import DecodeError
from plr.protos.model.ids import Role, Version
from plr.protos.model.members import Peer, PeerSet
from plr.protos.trust.identity import NOT_YET_VALID, UNTRUSTED, CertificateError
from plr.sidecar.core.seam.application import OfferService, ResponseArrived
from tests.support.joined_data_planes import Node, joined, submit

if TYPE_CHECKING:
    from collections.abc import Iterator

    from plr.protos.trust.credential import SessionCredential


@pytest.fixture
def nodes() -> Iterator[tuple[Node, Node]]:
    robot, cloud = Node("robot", Role.ROBOT, 1), Node("cloud", Role.CLOUD, 2)
    with joined(robot, cloud):
        robot.wait_for(OfferService)
        yield robot, cloud


def test_a_peer_that_trust_no_longer_covers_loses_its_session_at_once(nodes: tuple[Node, Node]) -> None:
    robot, cloud = nodes
    submit(robot, 1, b"before")
    robot.wait_for(ResponseArrived)

    def judge(credential: SessionCredential) -> float:
        raise DecodeError(f"{credential.name} is revoked")

    robot.own._verify = judge
    robot.plane.peer_trust.trust_changed()
    assert robot.plane.engine_stats.dropped["bad_credential"] == 1
    assert cloud.name not in robot.plane._engine.peers


def test_a_peer_refused_while_the_clock_was_wrong_is_talked_to_when_it_is_right(
    caplog: pytest.LogCaptureFixture,
) -> None:
    """Nobody sends the peers again: those on disk are the newest, and counted as taken."""
    seconds = itertools.count(1000, -1)
    wrong = True

    def judge(credential: SessionCredential) -> float:
        if wrong:
            raise CertificateError(NOT_YET_VALID, f"not valid yet, for {next(seconds)} s")
        return math.inf

    robot, cloud = Node("robot", Role.ROBOT, 1), Node("cloud", Role.CLOUD, 2)
    robot.own._verify = judge
    with joined(robot, cloud):
        for _ in range(3):
            robot.plane.peer_trust.judge_again()
            robot.plane.peer_trust.trust_changed()
        assert caplog.text.count("is refused, although the control plane names it") == 1
        assert cloud.name not in robot.plane._engine.peers
        wrong = False
        robot.plane.peer_trust.judge_again()
        robot.wait_for(OfferService)
        submit(robot, 1, b"at last")
        robot.wait_for(ResponseArrived)


def test_a_peer_of_a_ca_that_is_copied_late_is_talked_to_from_then_on(nodes: tuple[Node, Node]) -> None:
    robot, cloud = nodes

    def judge(credential: SessionCredential) -> float:
        raise CertificateError(UNTRUSTED, "the certificate is of another CA")

    believe, robot.own._verify = robot.own._verify, judge
    robot.plane.peer_trust.trust_changed()
    assert cloud.name not in robot.plane._engine.peers
    robot.own._verify = believe
    robot.plane.peer_trust.trust_changed()
    assert cloud.name in robot.plane._engine.peers
    submit(robot, 1, b"again")
    robot.wait_for(ResponseArrived)


@pytest.mark.audit("ops-3")
def test_forged_addresses_are_logged_once_and_so_is_their_end(
    nodes: tuple[Node, Node], monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """Who reads the warning has to know whether it still holds."""
    caplog.set_level(logging.INFO)
    robot, cloud = nodes
    versions = itertools.count(2)

    def tell(serial: int) -> list[str]:
        caplog.clear()
        told = replace(cloud.told_to(robot), candidates_serial=serial)
        assert robot.plane.apply_peers(PeerSet(Version(next(versions)), 1, (told,))) is None
        return [line.split(": ", 1)[1] for line in caplog.messages if line.startswith("cloud: ")]

    def refuse(_: Peer) -> bool:
        raise DecodeError("the signature of its addresses is wrong")

    with monkeypatch.context() as patch:
        patch.setattr(robot.own, "check_candidates", refuse)
        assert tell(1) == [
            "the addresses that the control plane sent for it are not used: the signature of its addresses is wrong"
        ]
        assert tell(2) == []
    assert tell(3) == ["the addresses that the control plane sent for it are used again"]
    assert tell(4) == []
