"""Two programs use the newest version that both speak; without one, the refusal says which of them to upgrade."""

from __future__ import annotations

import pytest

from plr.protos.model.protocol_versions import OURS, Spoken, refusal

pytestmark = pytest.mark.audit("ops-10")


@pytest.mark.parametrize(
    ("one", "other", "common"),
    [
        (Spoken(3, 3), Spoken(3, 3), 3),
        (Spoken(3, 4), Spoken(3, 3), 3),
        (Spoken(3, 4), Spoken(3, 4), 4),
        (Spoken(3, 4), Spoken(4, 5), 4),
        (Spoken(3, 3), Spoken(4, 5), None),
    ],
)
def test_the_newest_that_both_speak(one: Spoken, other: Spoken, common: int | None) -> None:
    assert one.common(other) == other.common(one) == common


def test_a_refusal_says_what_is_spoken_and_what_to_upgrade() -> None:
    assert refusal(Spoken(4, 5), Spoken(3, 4)) is None
    assert refusal(Spoken(2, 3), Spoken(3, 4)) is None
    assert refusal(Spoken(1, 2), Spoken(3, 4)) == (
        "the sidecar speaks protocol version 1 to 2, this control plane 3 to 4: upgrade the sidecar"
    )
    assert refusal(Spoken(5, 6), Spoken(3, 4)) == (
        "the sidecar speaks protocol version 5 to 6, this control plane 3 to 4: upgrade the control plane"
    )


def test_what_is_spoken_here_is_at_most_two_versions() -> None:
    assert OURS.newest - 1 <= OURS.oldest <= OURS.newest
