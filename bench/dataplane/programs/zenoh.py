"""Runs zenoh: a queryable, and queries to it over one session with several links, or one session for each link."""

from __future__ import annotations

import json
import threading
import time
from typing import TYPE_CHECKING, Any

import zenoh

from bench.dataplane.calling import HEADER, Caller, Compute, Plan, usage
from bench.dataplane.remote import serve

if TYPE_CHECKING:
    from collections.abc import Sequence

KEY = "bench/echo"
QUERY_TIMEOUT_S = 10.0
LINKS_TIMEOUT_S = 10.0


class ZenohProgram:
    """A client or server, depending on whether `listen` or `connect` comes first."""

    def __init__(self) -> None:
        self._sessions: list[zenoh.Session] = []
        self._caller = Caller(self._send)
        self._answer_bytes = HEADER.size
        self._compute = Compute()
        self._when_full = zenoh.CongestionControl.BLOCK

    def listen(
        self,
        ports: list[int],
        max_links: int,
        lease_ms: int,
        answer_bytes: int = HEADER.size,
        compute: dict[str, Any] | None = None,
    ) -> None:
        """Serve on these TCP ports of all addresses, a session for each, as `compute` (see `Compute`) says."""
        self._answer_bytes = answer_bytes
        self._compute = Compute(**(compute or {}))
        for port in ports:
            session = _open(max_links, lease_ms, listen=[f"tcp/0.0.0.0:{port}"])
            session.declare_queryable(KEY, self._on_query, complete=True)
            self._sessions.append(session)

    def connect(self, sessions: list[list[str]], max_links: int, lease_ms: int, *, drop: bool = False) -> None:
        """Open a session for each list of endpoints; return once each has all its links.

        With `drop`, a query that finds its session's queue full is dropped; by default it waits there.
        """
        if drop:
            self._when_full = zenoh.CongestionControl.DROP
        self._sessions = [_open(max_links, lease_ms, connect=endpoints) for endpoints in sessions]
        end = time.monotonic() + LINKS_TIMEOUT_S
        while any(
            len(session.info.links()) < len(endpoints)
            for session, endpoints in zip(self._sessions, sessions, strict=True)
        ):
            if time.monotonic() > end:
                raise TimeoutError("not all links came up")
            time.sleep(0.05)

    def call(self, **plan: Any) -> dict[str, Any]:
        """Send a plan's requests."""
        return self._caller.call(Plan(**plan))

    def usage(self) -> dict[str, float]:
        """Return processor seconds and peak of resident bytes."""
        return usage()

    def close(self) -> None:
        """End on threads that nobody waits for: a session whose link is dead takes seconds to close."""
        for session in self._sessions:
            threading.Thread(target=session.close, daemon=True).start()

    def _on_query(self, query: zenoh.Query) -> None:
        assert query.payload is not None
        self._compute.serve()
        query.reply(KEY, query.payload.to_bytes()[: self._answer_bytes])

    def _send(self, _number: int, data: bytes) -> None:
        for session in self._sessions:
            session.get(
                KEY,
                self._on_reply,
                payload=data,
                timeout=QUERY_TIMEOUT_S,
                target=zenoh.QueryTarget.ALL,
                consolidation=zenoh.ConsolidationMode.NONE,
                congestion_control=self._when_full,
            )

    def _on_reply(self, reply: zenoh.Reply) -> None:
        if reply.ok is not None:
            self._caller.answered(reply.ok.payload.to_bytes(), time.monotonic())


def _open(max_links: int, lease_ms: int, *, listen: Sequence[str] = (), connect: Sequence[str] = ()) -> zenoh.Session:
    config = zenoh.Config()
    settings = {
        "mode": "peer",
        "listen/endpoints": list(listen),
        "connect/endpoints": list(connect),
        "connect/timeout_ms": 5000,
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "transport/unicast/max_links": max_links,
        "transport/link/tx/lease": lease_ms,
    }
    for key, value in settings.items():
        config.insert_json5(key, json.dumps(value))
    return zenoh.open(config)


if __name__ == "__main__":
    zenoh.init_log_from_env_or("error")
    serve(ZenohProgram())
