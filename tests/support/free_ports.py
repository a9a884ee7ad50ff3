"""Ports for programs that cannot be asked which one the kernel gave them."""

from __future__ import annotations

import errno
import random
import socket

PORTS = range(20_000, 32_000)
"""Below Linux' ephemeral ports: no socket that asks for any port takes one away before it is used."""


def free_port(kind: socket.SocketKind = socket.SOCK_STREAM) -> int:
    """Return a port of both loopback addresses that nobody has right now."""
    rng = random.SystemRandom()
    while not _is_free(port := rng.choice(PORTS), kind):
        pass
    return port


def _is_free(port: int, kind: socket.SocketKind) -> bool:
    for family, host in ((socket.AF_INET, "127.0.0.1"), (socket.AF_INET6, "::1")):
        try:
            with socket.socket(family, kind) as probe:
                probe.bind((host, port))
        except OSError as error:  # a machine may have no IPv6
            if error.errno == errno.EADDRINUSE:
                return False
    return True
