"""Attacks the control plane besides a member's own stream: with connections, and streams that are refused.

`python -m lab.attacker.insider_streams TARGET FILE TLS_DIR=NAME=ROLE ...` uses these certificates while FILE.orders
exists, and counts in FILE.tally.
"""

from __future__ import annotations

import contextlib
import random
import socket
import sys
import threading
import time
from pathlib import Path
from typing import TYPE_CHECKING

from lab.attacker.control_client import CONNECT, call, open_channel
from lab.attacker.hostile_link import ESCAPES
from lab.attacker.insider import idle
from lab.attacker.junk import mangled, noise
from lab.attacker.orders import ORDERS, TALLY, Commander, Stage
from lab.attacker.registration import registration
from lab.attacker.tally import Tally
from plr.protos.model.ids import Role
from plr.protos.program.tls_files import load_tls_files
from plr.protos.stun.codec import MessageClass, StunMessage, encode

if TYPE_CHECKING:
    from collections.abc import Callable

    from plr.protos.program.tls_files import TlsFiles

SILENT = 200
"""Silent connections held open at once; half as many more have begun a handshake."""
CLIENT_HELLO = bytes.fromhex("1603010200010001fc0303")
STAY_S = 0.3
STUN_PORT = 3478
STUN_A_TURN = 50
TURN_S = 0.2
CONNECTIONS_A_TURN = 20


class Insider:
    """One certificate."""

    def __init__(self, folder: Path, name: str, role: Role) -> None:
        self.folder = folder
        self.name = name
        self.role = role
        self.files: TlsFiles = load_tls_files(folder)

    def registration(self, name: str, role: Role, incarnation: int | None = None, **more: int | str) -> bytes:
        """Return a registration under any name and role."""
        files = self.files
        return registration(files.certificate_der, files.private_key, name, role, incarnation, **more)  # type: ignore[arg-type]


class Streams:
    """All attacks on the control plane's port."""

    def __init__(self, target: str, file: Path, insiders: list[Insider]) -> None:
        self._target = target
        host, port = target.rsplit(":", 1)
        self._address = host, int(port)
        self._insiders = insiders
        self._commander = Commander(file.with_suffix(ORDERS))
        self._tally = Tally(file.with_suffix(TALLY))
        self._rng = random.Random(1)

    def run(self) -> None:
        """Attack until killed."""
        for attack in (self._connections, self._registrations, self._stun):
            threading.Thread(target=self._again_and_again, args=(attack,), daemon=True).start()
        while True:
            time.sleep(TURN_S)
            self._tally.write()

    def _again_and_again(self, attack: Callable[[], None]) -> None:
        while True:
            time.sleep(TURN_S)
            if self._commander.stage is not Stage.HONEST:
                attack()

    def _connections(self) -> None:
        """Hold silent connections open, and replace those that are closed."""
        held: list[socket.socket] = []
        while self._commander.want("silent connections"):
            for _ in range(min(CONNECTIONS_A_TURN, SILENT * 3 // 2 - len(held))):
                with contextlib.suppress(OSError):
                    connection = socket.create_connection(self._address, 1.0)
                    silent = self._rng.random() < 2 / 3
                    if not silent:
                        connection.sendall(CLIENT_HELLO)
                    connection.setblocking(False)
                    held.append(connection)
                    self._tally.add("silent connections" if silent else "handshakes begun and left")
            time.sleep(TURN_S)
            held = [connection for connection in held if _lives(connection)]
        for connection in held:
            connection.close()

    def _registrations(self) -> None:
        orders = self._commander.orders
        if orders is None or not orders.names:
            return
        rng = self._rng
        insider = rng.choice(self._insiders)
        other = rng.choice(orders.names)
        match rng.randrange(5):
            case 0:
                what, first = "registrations under another's name", insider.registration(other, rng.choice(list(Role)))
            case 1:
                what = "registrations with another session number"
                first = insider.registration(insider.name, insider.role, session=rng.getrandbits(63))
            case 2:
                what = "registrations of a session of before"
                first = insider.registration(insider.name, insider.role, 1)
            case 3:
                what = "registrations with escape sequences"
                first = insider.registration(insider.name, insider.role, 1, software_version=ESCAPES[:40])
            case _:
                what = "fuzzed streams"
                first = mangled(insider.registration(other, insider.role), rng)
        messages = [first, *(rng.choice((noise(rng), mangled(first, rng))) for _ in range(10))]
        if not self._commander.want(what):
            return
        with open_channel(self._target, insider.folder) as channel:
            call(channel, CONNECT, messages, STAY_S)
        self._tally.add(what, len(messages), sum(map(len, messages)))

    def _stun(self) -> None:
        if not self._commander.want("STUN questions"):
            return
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
            for _ in range(STUN_A_TURN):
                request = encode(StunMessage(MessageClass.REQUEST, self._rng.randbytes(12)))
                sock.sendto(request, (self._address[0], STUN_PORT))
            self._tally.add("STUN questions", STUN_A_TURN, STUN_A_TURN * len(request))


def _lives(connection: socket.socket) -> bool:
    try:
        if connection.recv(1):
            return True
    except BlockingIOError:
        return True
    except OSError:
        pass
    connection.close()
    return False


def main() -> int:
    """Run the command line."""
    idle()
    target, file, *who = sys.argv[1:]
    insiders = []
    for one in who:
        folder, name, role = one.split("=")
        insiders.append(Insider(Path(folder), name, Role(role)))
    Streams(target, Path(file), insiders).run()
    return 0


if __name__ == "__main__":
    sys.exit(main())
