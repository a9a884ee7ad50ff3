"""Derives a request's 128-bit identity from the sidecar's session and rmw's writer guid and sequence number.

Contract: never the service name, never reused. rmw numbers the requests of one client (its writer guid) one by one, and
each start draws a new session, so two different requests never have the same input. The hash only brings the three to
16 bytes (collision chance for 10^9 requests about 10^-21).
"""

from __future__ import annotations

import hashlib
from typing import TYPE_CHECKING

from plr.sidecar.core.base.values import RequestId

if TYPE_CHECKING:
    from plr.protos.model.ids import SessionId

REQUEST_ID_BYTES = 16
OBSERVED_ONE_IN = 8
"""One request in this many is a full race: no copy is called off because another won, and all are measured.

At 10 requests a second and the estimator's half-life of 60 s, this leaves each path a weight of 100 requests, where its
estimate rests on real requests alone. It saves seven eighths of what losers would waste.
"""


def make_request_id(session: SessionId, writer_guid: bytes, sequence_number: int) -> RequestId:
    """Return the id of the request that rmw calls (`writer_guid`, `sequence_number`)."""
    digest = hashlib.blake2b(digest_size=REQUEST_ID_BYTES, person=b"plr request id")
    digest.update(session.to_bytes(8, "big"))
    digest.update(sequence_number.to_bytes(8, "big", signed=True))
    digest.update(writer_guid)
    return RequestId(digest.digest())


def is_race(request_id: RequestId) -> bool:
    """Return whether all copies of a request are to be measured.

    The choice is by a hash (the id), so it does not depend on the outcome, and is not in step with anything that the
    application does every so many requests.
    """
    return request_id[-1] % OBSERVED_ONE_IN == 0
