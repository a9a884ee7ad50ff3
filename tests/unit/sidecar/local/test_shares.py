from __future__ import annotations

import pytest

from plr.sidecar.local.shares import MAX_USERS, Rate, Rates, UserShares

pytestmark = pytest.mark.audit("ops-14")

RATES = Rates(owner=Rate(1.0, 2.0), members=Rate(2.0, 6.0), member=Rate(1.0, 3.0))


def taken(shares: UserShares, user: int | None, tries: int, now: float = 0.0) -> int:
    return sum(shares.take(user, now) for _ in range(tries))


def test_members_take_nothing_from_the_owner_and_one_leaves_some_to_another() -> None:
    shares = UserShares(RATES, 0.0)
    assert taken(shares, 1000, 100) == 3
    assert taken(shares, 1001, 100) == 3
    assert taken(shares, 1002, 100) == 0  # all of the members' are used up
    assert taken(shares, None, 100) == 2


def test_who_asks_too_often_uses_up_only_his_own() -> None:
    shares = UserShares(RATES, 0.0)
    taken(shares, 1000, 10_000)
    # Had his refused ones counted, nothing would be left.
    assert taken(shares, 1001, 100) == 3


def test_they_come_back() -> None:
    shares = UserShares(RATES, 0.0)
    taken(shares, 1000, 100)
    assert taken(shares, 1000, 100, now=2.0) == 2


def test_users_who_use_nothing_up_are_forgotten() -> None:
    shares = UserShares(Rates(owner=Rate(1, 1), members=Rate(1e6, 1e6), member=Rate(1.0, 1.0)), 0.0)
    assert sum(taken(shares, user, 1) for user in range(2 * MAX_USERS)) == MAX_USERS
    assert sum(taken(shares, user, 1, now=10.0) for user in range(MAX_USERS, 2 * MAX_USERS)) == MAX_USERS
