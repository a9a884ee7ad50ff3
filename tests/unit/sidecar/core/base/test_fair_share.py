from __future__ import annotations

import pytest

from plr.protos.model.ids import NodeName
from plr.sidecar.core.base.fair_share import Shares
from tests.support.builders import A, B


def fill(shares: Shares, peer: NodeName) -> int:
    while shares.fits(peer):
        shares.take(peer)
    return shares.held(peer)


def test_one_greedy_peer_gets_half_and_every_further_one_leaves_something() -> None:
    shares = Shares(1024)
    assert fill(shares, A) == 512
    held = [fill(shares, NodeName(f"greedy-{number}")) for number in range(8)]
    assert held == [256, 128, 64, 32, 16, 8, 4, 2]
    assert shares.fits(B)


def test_units_given_back_are_free_again() -> None:
    shares = Shares(10)
    shares.take(A, 5)
    assert not shares.fits(A)
    shares.give_back(A, 2)
    assert (shares.held(A), shares.used) == (3, 3)
    assert shares.fits(A, 2)
    assert not shares.fits(A, 5)
    shares.give_back(A, 3)
    assert shares.used == 0
    assert not shares._held, "a peer that holds nothing is not remembered"


def test_giving_back_what_was_not_taken_is_a_bug() -> None:
    with pytest.raises(KeyError):
        Shares(10).give_back(A)


def test_nothing_may_be_taken_and_given_back() -> None:
    shares = Shares(10)
    for _ in range(2):
        shares.take(A, 0)
    for _ in range(2):
        shares.give_back(A, 0)
    assert (shares.used, shares.held(A), shares._held) == (0, 0, {})
