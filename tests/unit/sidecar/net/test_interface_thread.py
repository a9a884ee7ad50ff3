from __future__ import annotations

import random
import socket
import threading
import time
from typing import TYPE_CHECKING, Any

from lab.simulated.sessions import credential_of
from plr.protos.model.ids import InterfaceId, InterfaceName, Role
from plr.sidecar.core.link.link import Link
from plr.sidecar.core.link.sender import Batch, LinkIdentity
from plr.sidecar.core.stun.client import StunClient
from plr.sidecar.core.stun.events import Mapped
from plr.sidecar.net.interface_thread import InterfaceThread

if TYPE_CHECKING:
    import pytest

    from plr.sidecar.core.link.pinging import Pong
    from plr.sidecar.core.seam.links import LinkEvent
    from plr.sidecar.core.stun.events import StunEvent

PATIENCE_S = 20.0


class Owner:
    """Nobody's engine."""

    def on_link_events(self, events: list[LinkEvent]) -> None:
        pass

    def on_pong(self, pong: Pong) -> None:
        pass


class SlowSocket(socket.socket):
    """Every send waits for the test's leave."""

    def __init__(self) -> None:
        super().__init__(socket.AF_INET, socket.SOCK_DGRAM)
        self.setblocking(False)
        self.bind(("127.0.0.1", 0))
        self.leave = threading.Event()
        self.in_send = threading.Event()
        self.sends = 0

    def sendto(self, *_: Any) -> int:
        self.in_send.set()
        assert self.leave.wait(PATIENCE_S)
        self.sends += 1
        return 1


def a_link() -> Link:
    credential = credential_of("robot", Role.ROBOT, 1)
    identity = LinkIdentity.of(credential, bytes(16), InterfaceName("wlan0"), InterfaceId(0))
    return Link(identity, random.Random(1), time.monotonic())


def thread_with(sock: socket.socket, waiting: int) -> InterfaceThread:
    """A thread that has so many datagrams to send."""
    thread = InterfaceThread(sock, a_link(), None, Owner())
    thread._unsent.extend(Batch(("127.0.0.1", 9), b"x", 1) for _ in range(waiting))
    return thread


def test_it_is_in_a_turn_only_while_it_does_not_wait() -> None:
    sock = SlowSocket()
    thread = thread_with(sock, 1)
    assert thread.in_turn_for(time.monotonic()) == 0.0
    thread.start()
    assert sock.in_send.wait(PATIENCE_S)
    began = time.monotonic()
    time.sleep(0.01)
    now = time.monotonic()
    assert thread.in_turn_for(now) >= now - began
    sock.leave.set()
    end = time.monotonic() + PATIENCE_S
    while thread.in_turn_for(time.monotonic()) and time.monotonic() < end:
        time.sleep(0.001)
    assert thread.in_turn_for(time.monotonic()) == 0.0
    thread.stop(PATIENCE_S)
    assert sock.fileno() == -1


def test_a_thread_given_up_sends_nothing_more_once_its_driver_returns(caplog: pytest.LogCaptureFixture) -> None:
    sock = SlowSocket()
    thread = thread_with(sock, 5)
    thread.start()
    assert sock.in_send.wait(PATIENCE_S)
    thread.stop(0.01)
    assert "did not end within" in caplog.text
    sock.leave.set()
    thread._thread.join(PATIENCE_S)
    assert not thread._thread.is_alive()
    assert sock.sends == 1
    assert sock.fileno() == -1


def test_what_still_waits_leaves_before_the_thread_ends() -> None:
    sock = SlowSocket()
    sock.leave.set()
    thread = thread_with(sock, 5)
    thread.start()
    thread.stop(PATIENCE_S)
    assert sock.sends == 5


def test_stun_events_go_to_who_asked_for_them(monkeypatch: pytest.MonkeyPatch) -> None:
    events: list[StunEvent] = []
    stun = StunClient((), random.Random(1))
    mapped = Mapped(4, ("192.0.2.1", 9), ("192.0.2.2", 3478))
    monkeypatch.setattr(stun, "next_event", iter([mapped, None]).__next__)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        InterfaceThread(sock, a_link(), stun, Owner(), events.append)._stun_turn()
    assert events == [mapped]
