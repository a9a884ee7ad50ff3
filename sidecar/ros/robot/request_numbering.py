"""Gives each request of a local application its identity."""

from __future__ import annotations

from typing import TYPE_CHECKING

from plr.sidecar.core.base.request_id import make_request_id

if TYPE_CHECKING:
    from plr.protos.model.ids import SessionId
    from plr.sidecar.core.base.values import RequestId
    from plr.sidecar.ros.rcl import RmwRequestId


class RequestNumbering:
    """Names each request by session, writer guid and sequence number, so that no name occurs twice.

    Fast DDS forms its guids from host, process number and 16 random bits, so a client that keeps restarting in a
    container may repeat one of its own. So the arrival number in this session goes into the name too.
    """

    __slots__ = ("_arrivals", "_session")

    def __init__(self, session: SessionId) -> None:
        self._session = session
        self._arrivals = 0

    def identify(self, rmw_request_id: RmwRequestId) -> tuple[RequestId, bytes]:
        """Return (id of the request, guid of its client)."""
        self._arrivals += 1
        guid = bytes(rmw_request_id.writer_guid)
        identity = guid + self._arrivals.to_bytes(8, "big")
        return make_request_id(self._session, identity, rmw_request_id.sequence_number), guid
