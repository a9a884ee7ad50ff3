"""What the tests of the local socket have in common: a source of answers, raw clients, users other than root."""

from __future__ import annotations

import socket
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

from plr.protos.model.ids import InterfaceId, InterfaceName, NodeName
from plr.sidecar.core.base.values import PathId
from plr.sidecar.core.link.pinging import Pong

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from plr.sidecar.local.server import LocalSocketServer

PATIENCE_S = 20.0
NOBODY = 65534
ROOT = Path(__file__).parents[4]


class Source:
    """Answers pings itself, unless it is `mute`."""

    def __init__(self) -> None:
        self.server: LocalSocketServer | None = None
        self.mute = False
        self.parts = 3
        self.threads: set[str] = set()

    def state(self) -> Iterator[tuple[str, Any]]:
        self.threads.add(threading.current_thread().name)
        yield "node", {"name": "robot-1"}
        for number in range(self.parts):
            yield "paths", [{"interface": "wlan0", "peer": "x" * 100, "remote": number, "state": "up"}]

    def paths_to(self, peer: str, interface: str | None) -> list[PathId]:
        over = ["wlan0", "wwan0"] if interface is None else [interface]
        known = peer == "cloud-1"
        return [PathId(InterfaceName(name), NodeName(peer), InterfaceId(0)) for name in over] if known else []

    def ping(self, path: PathId, number: int, size: int) -> None:
        assert self.server is not None
        if not self.mute:
            self.server.on_pong(Pong(number, path, 0.012))


def raw(server: LocalSocketServer, patience_s: float = PATIENCE_S) -> socket.socket:
    sock = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    sock.settimeout(patience_s)
    try:
        sock.connect(str(server.path))
    except OSError:
        sock.close()
        raise
    return sock


def wait_until(what: Any) -> None:
    end = time.monotonic() + PATIENCE_S
    while not what():
        assert time.monotonic() < end
        time.sleep(0.01)


def reachable(folder: Path) -> list[Path]:
    """The folders of pytest that others may not enter, as many as there are on the way."""
    return [one for one in (folder, *folder.parents) if one.name.startswith(("pytest-", "popen-", "test_"))]


def as_user(user: int, groups: Sequence[int], script: str) -> subprocess.Popen[str]:
    """Run a script as another user, who is a member of these groups; it is killed by whoever leaves the `with`."""
    become = f"import os; os.setgroups({list(groups)}); os.setgid({NOBODY}); os.setuid({user})\n"
    # What it needs of the checkout is imported before: that user may not be able to read it.
    imports = "import json, pathlib, socket, sys, time\nfrom plr.sidecar.local.client import LocalClient, LocalError\n"
    argv = [sys.executable, "-c", imports + become + script]
    return subprocess.Popen(argv, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=ROOT)
