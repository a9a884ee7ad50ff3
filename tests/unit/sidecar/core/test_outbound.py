from __future__ import annotations

from tests.unit.sidecar.core.builders import A, message


def test_symbols_cover_the_data() -> None:
    outbound = message(size=3000)
    assert outbound.count == 3
    assert b"".join(outbound.symbol_data(index) for index in range(3)) == bytes(outbound.data)
    assert outbound.peer == A


def test_an_empty_message_still_has_a_symbol_to_travel() -> None:
    outbound = message(size=0)
    assert outbound.missing() == (0,)
    assert bytes(outbound.symbol_data(0)) == b""


def test_acknowledged_symbols_and_messages_that_are_over_need_nothing() -> None:
    outbound = message(size=3000)
    outbound.acked[1] = 1
    assert outbound.missing() == (0, 2)
    outbound.over = True
    assert outbound.missing() == ()
    assert not outbound.needs(0)
