from __future__ import annotations

import random
import socket
import time

import pytest

from lab.simulated.sessions import credential_of
from plr.protos.model.ids import InterfaceId, InterfaceName, NodeName, Role
from plr.sidecar.core.base.values import PathId, PathState
from plr.sidecar.core.link.link import Link
from plr.sidecar.core.link.sender import LinkIdentity
from plr.sidecar.core.seam.links import PathChanged
from plr.sidecar.net.interface_thread import InterfaceThread
from plr.sidecar.net.sources import Sources
from tests.unit.sidecar.net.test_interface_thread import Owner

pytestmark = pytest.mark.audit("dp-14")


def udp(host: str, family: int = socket.AF_INET) -> socket.socket:
    sock = socket.socket(family, socket.SOCK_DGRAM)
    sock.bind((host, 0))
    return sock


def test_the_kernel_says_where_an_unbound_socket_sends_from() -> None:
    with udp("0.0.0.0") as sock:
        assert Sources(sock).towards(("127.0.0.1", 9)) == "127.0.0.1"
        assert Sources(sock).towards(("127.9.9.9", 9)) == "127.0.0.1"


def test_a_bound_socket_sends_from_where_it_is_bound() -> None:
    with udp("127.0.0.5") as sock:
        assert Sources(sock).towards(("127.0.0.1", 9)) == "127.0.0.5"


def test_no_way_there_is_no_source() -> None:
    with udp("0.0.0.0") as sock:
        assert Sources(sock).towards(("no address", 9)) is None


def test_a_path_that_comes_up_is_told_where_it_leaves_from(monkeypatch: pytest.MonkeyPatch) -> None:
    identity = LinkIdentity.of(credential_of("robot", Role.ROBOT, 1), bytes(16), InterfaceName("lo"), InterfaceId(0))
    link = Link(identity, random.Random(1), time.monotonic())
    asked: list[PathId] = []
    monkeypatch.setattr(link, "note_source", lambda path, towards: asked.append(path))
    path = PathId(InterfaceName("lo"), NodeName("cloud"), InterfaceId(0))
    with udp("127.0.0.1") as sock:
        thread = InterfaceThread(sock, link, None, Owner())
        thread._note_paths([PathChanged(path, PathState.DOWN, ""), PathChanged(path, PathState.UP, "")])
    assert asked == [path]
