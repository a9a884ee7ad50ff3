"""Decoding repair symbols has a thread of its own, outside the engine's lock."""

from __future__ import annotations

import random
import threading
from typing import TYPE_CHECKING

import pytest

from lab.simulated.sessions import session_of
from plr.protos.model.ids import InterfaceName, Role, SessionId, Version
from plr.protos.model.members import PeerSet, ServiceOffer
from plr.sidecar.core.base.values import Priority
from plr.sidecar.core.engine.engine import EngineConfig
from plr.sidecar.core.message.decoding import Decoding
from plr.sidecar.core.message.partial import Partial
from plr.sidecar.core.message.symbols import MessageSymbols
from plr.sidecar.core.seam.application import ExecuteRequest
from plr.sidecar.core.seam.links import FragmentsReceived
from plr.sidecar.core.wire.frame import Fragment
from plr.sidecar.core.wire.messages import RequestMessage, encode_message
from plr.sidecar.net.dataplane import DataPlaneHooks, ThreadedDataPlane
from plr.sidecar.net.decoder import Decoder
from tests.support.builders import ECHO, TYPE, path, peer, request_id, rule

if TYPE_CHECKING:
    from plr.sidecar.core.seam.application import ApplicationEvent

PATIENCE_S = 20.0
"""For a loaded machine; nothing here takes long."""


class Application:
    """Keeps what it is told."""

    def __init__(self) -> None:
        self.events: list[ApplicationEvent] = []
        self.told = threading.Event()

    def handle(self, event: ApplicationEvent) -> None:
        self.events.append(event)
        self.told.set()


@pytest.mark.audit("dp-10")
def test_messages_are_decoded_on_no_interfaces_thread_while_nothing_is_locked(monkeypatch: pytest.MonkeyPatch) -> None:
    application = Application()
    hooks = DataPlaneHooks(application, lambda: None, lambda: None, lambda _: None, lambda *_: None)
    plane = ThreadedDataPlane(EngineConfig(Role.CLOUD, (rule(),)), session_of("me", Role.CLOUD, 9), hooks)
    plane.set_offers((ServiceOffer(ECHO, TYPE),))
    assert plane.apply_peers(PeerSet(Version(1), 1, (peer("robot"),))) is None
    payload = random.Random(1).randbytes(5000)
    request = RequestMessage(request_id(1), 0, Priority.NORMAL, 1.0, 10.0, ECHO, TYPE, payload)
    over = path(InterfaceName("eth0"), "robot")
    message = MessageSymbols(1, encode_message(request), deadline=1.0, expires=2.0, repairs=1)
    fragments = [
        Fragment(1, message.total, message.symbol, index, memoryview(message.symbol_data(index)))
        for index in range(1, len(message))
    ]

    run_slice = Decoding.run_slice
    locked: list[bool] = []
    threads: list[str] = []

    def ask() -> None:
        free = plane._lock.acquire(blocking=False)
        locked.append(not free)
        if free:
            plane._lock.release()

    def watched(decoding: Decoding) -> bool:
        threads.append(threading.current_thread().name)
        asking = threading.Thread(target=ask)
        asking.start()
        asking.join()
        return run_slice(decoding)

    monkeypatch.setattr(Decoding, "run_slice", watched)
    plane.start()
    try:
        plane.on_link_events([FragmentsReceived(over, SessionId(1), fragments)])
        assert application.told.wait(PATIENCE_S)
    finally:
        plane.stop()
    assert locked == [False]
    assert threads == ["plr-decoder"]
    (event,) = application.events
    assert isinstance(event, ExecuteRequest)
    assert event.payload == payload


class Owner:
    """Has these to decode; the first fails."""

    def __init__(self, decodings: list[Decoding]) -> None:
        self.left = decodings
        self.decoded: list[Decoding] = []
        self.failed: list[Decoding] = []
        self.over = threading.Event()

    def next_decoding(self) -> Decoding | None:
        return self.left[0] if self.left else None

    def on_decoded(self, decoding: Decoding) -> None:
        self.decoded.append(self.left.pop(0))
        self.over.set()

    def on_decoding_failed(self, decoding: Decoding) -> None:
        self.failed.append(self.left.pop(0))


def test_an_internal_error_costs_one_message(caplog: pytest.LogCaptureFixture) -> None:
    over = path(InterfaceName("eth0"), "robot")
    bad, good = (Decoding(over, SessionId(1), Partial(number, 600, 300, 0.0)) for number in (1, 2))
    del bad.partial.have
    bad.partial.add_repair(0, memoryview(bytes(300)))
    owner = Owner([bad, good])
    decoder = Decoder(owner)
    decoder.start()
    decoder.wake()
    try:
        assert owner.over.wait(PATIENCE_S)
    finally:
        decoder.stop(PATIENCE_S)
    assert owner.failed == [bad]
    assert owner.decoded == [good]
    assert "internal error" in caplog.text
