"""Runs the attacker as a program: floods a port with junk, from any number of its own ports."""

from __future__ import annotations

import base64
import contextlib
import random
import socket
import time
from typing import TYPE_CHECKING, Any

from bench.dataplane.remote import serve
from lab.attacker.junk import JunkKind, make_junk
from lab.attacker.send_many import flood

if TYPE_CHECKING:
    from collections.abc import Iterator

POOL = 4096
"""Different datagrams of a flood, sent repeatedly."""
SOURCES = 16
ROUND = 20_000
"""Datagrams that a fuzzer makes before it sends them."""


class FloodProgram:
    """One attacker that knows some real datagrams (`seen`, in base64)."""

    def flood(
        self, address: str, port: int, kind: str, seen: list[str], rate_hz: float, seconds: float
    ) -> dict[str, Any]:
        """Flood an address with junk of a kind; return how much was sent and what that cost."""
        pool = make_junk(JunkKind(kind), _decoded(seen), POOL, random.Random(1))
        with _sockets(address, port) as sockets:
            cpu = time.process_time()
            sent = flood(sockets, pool, rate_hz, seconds)
            return {"sent": sent, "cpu_s": time.process_time() - cpu}

    def fuzz(self, address: str, port: int, seen: list[str], rate_hz: float, count: int, seed: int) -> int:
        """Send junk of all kinds, each datagram different; return how many there were."""
        rng = random.Random(seed)
        known = _decoded(seen)
        sent = 0
        with _sockets(address, port) as sockets:
            while sent < count:
                kinds = list(JunkKind) if known else [JunkKind.NOISE]
                pool = [junk for kind in kinds for junk in make_junk(kind, known, ROUND // len(kinds), rng)]
                rng.shuffle(pool)
                sent += flood(sockets, pool, rate_hz, len(pool) / rate_hz)
        return sent

    def close(self) -> None:
        """Do nothing: there is nothing to end."""


def _decoded(seen: list[str]) -> list[bytes]:
    return [base64.b64decode(one) for one in seen]


@contextlib.contextmanager
def _sockets(address: str, port: int) -> Iterator[list[socket.socket]]:
    """Yield connected sockets with different local ports."""
    family = socket.AF_INET6 if ":" in address else socket.AF_INET
    with contextlib.ExitStack() as stack:
        sockets = [stack.enter_context(socket.socket(family, socket.SOCK_DGRAM)) for _ in range(SOURCES)]
        for sock in sockets:
            sock.connect((address, port))
        yield sockets


if __name__ == "__main__":
    serve(FloodProgram())
