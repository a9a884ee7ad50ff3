"""Limits how often each user may do something, so that no user starves the others, and all together not root.

Pure: the callers pass the time.
"""

from __future__ import annotations

from dataclasses import dataclass

from plr.protos.base.token_bucket import TokenBucket

MAX_USERS = 64
"""Users remembered, those that have used up something; all of them together have few tokens to use up."""


@dataclass(frozen=True, slots=True)
class Rate:
    """A rate: `at_once` immediately, and `per_s` a second after that."""

    per_s: float
    at_once: float

    def bucket(self, now: float) -> TokenBucket:
        """Return a bucket, full at `now`."""
        return TokenBucket(rate=self.per_s, burst=self.at_once, now=now)


@dataclass(frozen=True, slots=True)
class Rates:
    """Rates for one kind of request."""

    owner: Rate
    """Rate of root and the sidecar's own user, who take nothing from the members."""
    members: Rate
    """Rate of all other users together."""
    member: Rate
    """Rate of one of them."""


class UserShares:
    """Counts requests of one kind by user (None: the owner); times are monotonic seconds."""

    def __init__(self, rates: Rates, now: float) -> None:
        self._member = rates.member
        self._owner = rates.owner.bucket(now)
        self._members = rates.members.bucket(now)
        self._by_user: dict[int, TokenBucket] = {}

    def take(self, user: int | None, now: float) -> bool:
        """Take a token; return False, and take none from anybody else, if this user has none left."""
        if user is None:
            return self._owner.take(now)
        bucket = self._by_user.get(user) or self._new(user, now)
        # The user's own first: a user who asks too often must not use up the shared tokens.
        return bucket is not None and bucket.take(now) and self._members.take(now)

    def _new(self, user: int, now: float) -> TokenBucket | None:
        if len(self._by_user) >= MAX_USERS:
            self._by_user = {one: bucket for one, bucket in self._by_user.items() if not bucket.is_full(now)}
            if len(self._by_user) >= MAX_USERS:
                return None
        bucket = self._by_user[user] = self._member.bucket(now)
        return bucket
