"""A full look for garbage is worth its time when memory grows by more than members explain."""

from __future__ import annotations

import pytest

from plr.controlplane.garbage import MEMBER_BYTES, ROOM_BYTES, GarbageWatch

MB = 1024 * 1024


@pytest.mark.audit("ops-19")
def test_members_that_come_are_no_garbage() -> None:
    watch = GarbageWatch()
    assert not watch.worth_a_look(150 * MB, 0)
    assert not watch.worth_a_look(150 * MB + 4096 * MEMBER_BYTES, 4096)


@pytest.mark.audit("ops-19")
def test_what_grows_beyond_them_is_worth_a_look() -> None:
    watch = GarbageWatch()
    assert not watch.worth_a_look(100 * MB, 0)
    assert not watch.worth_a_look(100 * MB + ROOM_BYTES, 0)
    assert watch.worth_a_look(100 * MB + ROOM_BYTES + 1, 0)


@pytest.mark.audit("ops-19")
def test_what_a_look_did_not_free_is_not_looked_at_again_soon() -> None:
    """Each look costs time by all that is there; so the next one waits for a share of that."""
    watch, resident, looks = GarbageWatch(), 100 * MB, 0
    assert not watch.worth_a_look(resident, 0)
    while resident < 3200 * MB:
        resident += MB
        if watch.worth_a_look(resident, 0):
            looks += 1
            watch.looked(resident, 0)
    assert 3 < looks <= 16


@pytest.mark.audit("ops-19")
def test_members_that_left_do_not_hide_what_they_leave() -> None:
    watch = GarbageWatch()
    assert not watch.worth_a_look(150 * MB, 0)
    full = 150 * MB + 1000 * MEMBER_BYTES
    assert not watch.worth_a_look(full, 1000)
    assert watch.worth_a_look(full, 0)
