"""Decoding repair symbols is the driver's, outside the engine's lock."""

from __future__ import annotations

import random
import threading
from typing import TYPE_CHECKING

from protos.model import InterfaceName, PeerSet, Role, ServiceOffer, SessionId, Version
from sidecar.core.engine import EngineConfig
from sidecar.core.events import ExecuteRequest
from sidecar.core.frame import Fragment
from sidecar.core.link_events import FragmentsReceived
from sidecar.core.messages import RequestMessage, encode_message
from sidecar.core.outbound import OutboundMessage
from sidecar.core.partial import Partial
from sidecar.core.priority import Priority
from sidecar.net.dataplane import DataPlaneHooks, ThreadedDataPlane
from tests.sessions import session_of
from tests.unit.sidecar.core.builders import ECHO, TYPE, path, peer, request_id, rule

if TYPE_CHECKING:
    import pytest

    from sidecar.core.events import ApplicationEvent


class Application:
    """Keeps what it is told."""

    def __init__(self) -> None:
        self.events: list[ApplicationEvent] = []

    def handle(self, event: ApplicationEvent) -> None:
        self.events.append(event)


def test_messages_are_decoded_while_nothing_is_locked(monkeypatch: pytest.MonkeyPatch) -> None:
    application = Application()
    hooks = DataPlaneHooks(application, lambda _interface, _event: None, lambda: None, lambda: None, lambda _: None)
    plane = ThreadedDataPlane(EngineConfig(Role.CLOUD, (rule(),)), session_of("me", Role.CLOUD, 9), hooks)
    plane.set_offers((ServiceOffer(ECHO, TYPE),))
    assert plane.apply_peers(PeerSet(Version(1), 1, (peer("robot"),))) is None
    payload = random.Random(1).randbytes(5000)
    request = RequestMessage(request_id(1), 0, Priority.NORMAL, 1.0, 10.0, ECHO, TYPE, payload)
    over = path(InterfaceName("eth0"), "robot")
    message = OutboundMessage(1, over, encode_message(request), deadline=1.0, expires=2.0, repairs=1)
    fragments = [
        Fragment(1, message.total, message.symbol, index, memoryview(message.symbol_data(index)))
        for index in range(1, message.symbols)
    ]

    decode = Partial.decode
    locked: list[bool] = []

    def ask() -> None:
        free = plane._lock.acquire(blocking=False)
        locked.append(not free)
        if free:
            plane._lock.release()

    def watched(partial: Partial) -> memoryview:
        asking = threading.Thread(target=ask)
        asking.start()
        asking.join()
        return decode(partial)

    monkeypatch.setattr(Partial, "decode", watched)
    plane.on_link_events([FragmentsReceived(over, SessionId(1), fragments)])
    assert locked == [False]
    (event,) = application.events
    assert isinstance(event, ExecuteRequest)
    assert event.payload == payload
