"""Identity of a request: 128 bits from the sidecar's session and rmw's writer guid and sequence number.

Contract: never the service name, never reused. rmw numbers the requests of one client (its writer guid) one by
one, and the session is drawn afresh at every start, so two different requests never meet in the input; the hash
only brings the three to 16 bytes (collision chance for 10^9 requests about 10^-21).
"""

from __future__ import annotations

import hashlib
from typing import TYPE_CHECKING

from sidecar.core.base.values import RequestId

if TYPE_CHECKING:
    from protos.model.ids import SessionId

REQUEST_ID_BYTES = 16
OBSERVED_ONE_IN = 8
"""One request in so many is a full race: no copy is called off because another won, and all are measured.

At 10 requests a second and the estimator's half-life of 60 s, this leaves the weight of 100 requests for each path,
where its estimate stands on real requests alone; seven eighths of what losers would waste are saved."""


def make_request_id(session: SessionId, writer_guid: bytes, sequence_number: int) -> RequestId:
    """Return the id of the request that rmw calls (`writer_guid`, `sequence_number`)."""
    digest = hashlib.blake2b(digest_size=REQUEST_ID_BYTES, person=b"plr request id")
    digest.update(session.to_bytes(8, "big"))
    digest.update(sequence_number.to_bytes(8, "big", signed=True))
    digest.update(writer_guid)
    return RequestId(digest.digest())


def is_race(request_id: RequestId) -> bool:
    """Whether a request is one of those of which all copies are to be measured.

    By a hash (the id), so without regard to the outcome, nor in step with anything that the application does every so
    many requests.
    """
    return request_id[-1] % OBSERVED_ONE_IN == 0
