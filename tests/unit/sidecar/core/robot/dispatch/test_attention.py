from __future__ import annotations

from plr.sidecar.core.robot.dispatch.attention import ATTEND_EVERY_S, Attention
from plr.sidecar.core.seam.links import Attend, LinkCommand
from tests.support.builders import A, B


def test_links_are_told_of_each_server_once_in_a_while() -> None:
    commands: list[LinkCommand] = []
    attention = Attention(commands.append)
    attention.ask_for((A,), 0.0)
    attention.ask_for((A,), 0.1)
    attention.ask_for((A, B), 0.2)
    attention.ask_for((B,), 0.3)
    assert commands == [Attend(frozenset((A,))), Attend(frozenset((A, B)))]
    attention.ask_for((B,), ATTEND_EVERY_S)
    assert commands[2:] == [Attend(frozenset((B,)))]


def test_no_server_is_nothing_to_tell() -> None:
    commands: list[LinkCommand] = []
    Attention(commands.append).ask_for((), 0.0)
    assert commands == []
