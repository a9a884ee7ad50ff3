from __future__ import annotations

import itertools

from plr.protos.model.ids import SessionId
from plr.sidecar.core.base.request_id import REQUEST_ID_BYTES, make_request_id


def test_every_part_of_the_identity_counts() -> None:
    guids = [bytes(16), b"\1" + bytes(15), bytes(15) + b"\1", bytes(24)]
    inputs = itertools.product((0, 1, 2**64 - 1), guids, (-1, 0, 1, 2**62))
    ids = {make_request_id(SessionId(session), guid, sequence) for session, guid, sequence in inputs}
    assert len(ids) == 3 * 4 * 4
    assert {len(request_id) for request_id in ids} == {REQUEST_ID_BYTES}


def test_the_same_request_has_the_same_id_and_the_next_hundred_thousand_others() -> None:
    session, guid = SessionId(42), bytes(range(16))
    ids = {make_request_id(session, guid, number) for number in range(100_000)}
    assert len(ids) == 100_000
    assert make_request_id(session, guid, 7) in ids


def test_the_hash_does_not_change_between_versions() -> None:
    assert make_request_id(SessionId(1), b"guid", 2).hex() == GOLDEN


GOLDEN = "ad90b2cc557d7a3b02cfe4769cf6d19d"
