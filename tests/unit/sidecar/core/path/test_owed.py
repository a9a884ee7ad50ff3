from __future__ import annotations

from plr.sidecar.core.base.timers import NEVER
from plr.sidecar.core.path.owed import MAX_PENDING_FINISHED, MAX_PENDING_FRAMES, Owed
from plr.sidecar.core.wire.frame import (
    FINISHED_TYPE,
    Abandon,
    Finished,
    ProbeReply,
    encode_abandon,
    encode_finished,
    encode_probe_reply,
)

REPLY = encode_probe_reply(ProbeReply(1))
ABANDON = encode_abandon(Abandon(2))


def test_what_is_owed_leaves_by_the_earliest_moment_and_once() -> None:
    owed = Owed()
    assert owed.by == NEVER
    assert owed.add(REPLY, 2.0)
    assert owed.add_finished(7, 1.0)
    assert owed.add_finished(7, 3.0)
    assert owed.by == 1.0
    assert owed.take() == [REPLY, encode_finished(Finished(7))]
    assert owed.by == NEVER
    assert owed.take() == []


def test_frames_and_finished_are_capped_separately() -> None:
    owed = Owed()
    assert all(owed.add(REPLY, 1.0) for _ in range(MAX_PENDING_FRAMES))
    assert not owed.add(REPLY, 0.5)
    assert all(owed.add_finished(number, 1.0) for number in range(MAX_PENDING_FINISHED))
    assert not owed.add_finished(MAX_PENDING_FINISHED, 0.5)
    assert owed.add_finished(0, 1.0), "it waits already"
    assert owed.by == 1.0
    assert len(owed.take()) == MAX_PENDING_FRAMES + MAX_PENDING_FINISHED


def test_frames_of_a_type_can_be_withdrawn() -> None:
    owed = Owed()
    owed.add(REPLY, 1.0)
    owed.add(ABANDON, 1.0)
    owed.withdraw(REPLY[0])
    assert owed.take() == [ABANDON]


def test_what_may_not_leave_yet_waits_again_as_far_as_there_is_room() -> None:
    owed = Owed()
    assert owed.put_back([REPLY, ABANDON], 3.0) == 0
    assert owed.by == 3.0
    assert owed.take() == [REPLY, ABANDON]
    assert owed.put_back([REPLY] * (MAX_PENDING_FRAMES + 2), 3.0) == 2
    assert len(owed.take()) == MAX_PENDING_FRAMES


def test_finished_can_be_taken_alone() -> None:
    owed = Owed()
    owed.add(REPLY, 1.0)
    owed.add_finished(3, 1.0)
    assert owed.take_finished() == (3,)
    assert all(encoded[0] != FINISHED_TYPE for encoded in owed.take())
