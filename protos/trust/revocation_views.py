"""Prepares what both programs show of their revocation lists, in metrics and in the operator's status."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

from plr.protos.model.members import HeldList, RevocationSet

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from plr.protos.trust.identity import RevocationList


MAX_LIST_NUMBER = (1 << 64) - 1
"""Largest number that fits in a message; a list's number may be longer (RFC 5280 section 5.2.3)."""


class RevocationGauge(NamedTuple):
    """A gauge: its name, its description, and its value by CA."""

    name: str
    text: str
    by_ca: dict[tuple[str, ...], float]


def revocation_gauges(lists: Mapping[int, RevocationList | None], now_wall: float) -> Iterator[RevocationGauge]:
    """Yield the gauges; `lists` is as from `Trust.lists`, `now_wall` in seconds since 1970."""
    held = {(f"{ca:016x}",): one for ca, one in lists.items()}
    yield RevocationGauge(
        "plr_revocation_list_number",
        "Number of the newest revocation list of each CA, -1 for none.",
        {ca: -1.0 if one is None else float(one.number) for ca, one in held.items()},
    )
    known = {ca: one for ca, one in held.items() if one is not None}
    yield RevocationGauge(
        "plr_revocation_list_age_seconds",
        "Since the CA signed it, by this clock; negative: the clock is behind.",
        {ca: now_wall - one.signed_at for ca, one in known.items()},
    )
    yield RevocationGauge(
        "plr_revocation_list_left_seconds",
        "Until the time at which the list says that there is another.",
        {ca: one.next_at - now_wall for ca, one in known.items() if math.isfinite(one.next_at)},
    )


def revocation_set(lists: Mapping[int, RevocationList | None], too_old: int = 0) -> RevocationSet:
    """Return what to report about these lists; `too_old` is the number of CAs whose list is too old."""
    held = [
        HeldList(ca, min(one.number, MAX_LIST_NUMBER), int(one.signed_at))
        for ca, one in lists.items()
        if one is not None
    ]
    return RevocationSet(tuple(held), too_old)
