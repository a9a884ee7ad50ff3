"""The attacker as a program: floods a port with junk, from as many ports of its own as wanted."""

from __future__ import annotations

import base64
import random
import socket
import time
from typing import Any

from bench.attacker.junk import JunkKind, make_junk
from bench.attacker.send_many import flood
from bench.dataplane.remote import serve

POOL = 4096
"""Different datagrams, sent over and over."""


class FloodProgram:
    """One attacker."""

    def flood(
        self, address: str, port: int, kind: str, seen: list[str], rate_hz: float, seconds: float, sources: int = 16
    ) -> dict[str, Any]:
        """Flood an address (IPv4); `seen` are real datagrams in base64. Returns what it sent and what that cost."""
        pool = make_junk(JunkKind(kind), [base64.b64decode(one) for one in seen], POOL, random.Random(1))
        sockets = [socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(sources)]
        for sock in sockets:
            sock.connect((address, port))
        cpu = time.process_time()
        sent = flood(sockets, pool, rate_hz, seconds)
        for sock in sockets:
            sock.close()
        return {"sent": sent, "cpu_s": time.process_time() - cpu}

    def close(self) -> None:
        """Nothing to end."""


if __name__ == "__main__":
    serve(FloodProgram())
