from __future__ import annotations

import pytest

from plr.protos.model.ids import NodeName
from plr.sidecar.core.robot.dispatch.penalties import FIRST_S, HALF_LIFE_S, LONGEST_S, MAX_SERVERS, Penalties

A, B = NodeName("cloud-a"), NodeName("cloud-b")


def test_a_bad_answer_puts_its_server_out_of_favour_for_a_while() -> None:
    penalties = Penalties()
    assert penalties.favoured((A, B), 0.0) == (A, B)
    assert penalties.bad_answer(A, 0.0) == FIRST_S
    assert penalties.favoured((A, B), FIRST_S / 2) == (B,)
    assert penalties.favoured((A,), FIRST_S / 2) == (A,), "where no other is"
    assert penalties.favoured((A, B), FIRST_S) == (A, B)


def test_the_more_of_them_the_longer() -> None:
    penalties = Penalties()
    outs = [penalties.bad_answer(A, 0.0) for _ in range(12)]
    assert outs[:3] == [FIRST_S, 2 * FIRST_S, 4 * FIRST_S]
    assert outs[-1] == LONGEST_S
    assert penalties.bad_answer(A, 20 * HALF_LIFE_S) < 1.01 * FIRST_S, "forgiven"


def test_no_more_are_remembered_than_there_is_room_for() -> None:
    penalties = Penalties()
    for number in range(3 * MAX_SERVERS):
        penalties.bad_answer(NodeName(f"cloud-{number}"), number * 1e-3)
    assert len(penalties._records) == MAX_SERVERS
    assert penalties.out_until(NodeName(f"cloud-{3 * MAX_SERVERS - 1}")) > FIRST_S


@pytest.mark.audit("sec-2")
def test_thousands_of_them_at_once_are_no_error() -> None:
    penalties = Penalties()
    outs = [penalties.bad_answer(A, 0.0) for _ in range(8192)]
    assert outs[-1] == LONGEST_S
