"""The cloud's side of ROS without ROS: who is asked, and who gets the room that others leave."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import pytest

from plr.protos.model.ids import NodeName
from plr.sidecar.core.base.fair_share import Shares
from plr.sidecar.core.base.values import ExecutionId, Priority
from plr.sidecar.core.seam.application import AbandonExecution
from plr.sidecar.ros.cloud.cloud_side import MAX_PENDING_CALLS, SILENCE_S, TRUSTED_S, CloudSide
from plr.sidecar.ros.cloud.request_window import RequestWindow
from plr.sidecar.ros.cloud.service_runner import ServiceRunner
from plr.sidecar.ros.stats import BridgeStats


@pytest.fixture
def side() -> Any:
    """One whose loop and data plane do nothing."""
    made: Any = CloudSide.__new__(CloudSide)
    made._stats = BridgeStats()
    made._calls = {}
    made._shares = Shares(MAX_PENDING_CALLS)
    made._paced = set()
    made._at_work = set()
    made._in_doubt = frozenset()
    return made


@pytest.mark.audit("dp-15")
def test_a_dead_server_beside_a_living_one_keeps_nothing_from_it(side: Any) -> None:
    """A container that was restarted: DDS shows its dead self for 20 s more."""
    side._processes = SimpleNamespace(watches=lambda _endpoint: False, has_ended=lambda _endpoint: False)
    silent = {b"old"}
    side._roll_call = SimpleNamespace(
        has_heard=lambda endpoint, _since: endpoint not in silent, is_silent=lambda endpoint: endpoint in silent
    )
    runner = Mock(server=SimpleNamespace(endpoints=frozenset((b"old", b"new")), living=1))
    assert side._is_alive_since(runner, 1.0)
    silent.add(b"new")
    runner.server.living = 0
    assert not side._is_alive_since(runner, 1.0)


@pytest.mark.audit("dp-15")
def test_a_watched_server_that_answers_nothing_must_be_heard(side: Any) -> None:
    """Its end would have been noticed, but it may stand still."""
    ended: set[bytes] = set()
    heard_at = {b"one": 1.0}
    side._processes = SimpleNamespace(watches=lambda _endpoint: True, has_ended=ended.__contains__)
    side._roll_call = SimpleNamespace(has_heard=lambda endpoint, since: heard_at[endpoint] >= since)
    server = SimpleNamespace(endpoints=frozenset((b"one",)), lost=False)
    runner = Mock(server=server, silent_since=10.0, window=Mock(waiting=0))
    side._at_work = {runner}
    assert side._endpoints_to_ask(10.0 + SILENCE_S / 2) == []
    assert side._is_alive_since(runner, 10.0)
    assert side._endpoints_to_ask(10.0 + SILENCE_S) == [b"one"]
    assert not side._is_alive_since(runner, 10.0)
    heard_at[b"one"] = 11.0
    assert side._is_alive_since(runner, 10.0)
    assert side._endpoints_to_ask(11.5) == []
    assert side._is_alive_since(runner, 10.0)
    runner.window.waiting = 1
    assert side._endpoints_to_ask(11.5) == [b"one"]
    runner.window.waiting = 0
    assert side._endpoints_to_ask(13.0) == [b"one"]
    heard_at[b"one"] = 30.0
    assert side._endpoints_to_ask(30.0 + TRUSTED_S - 0.1) == []
    assert side._endpoints_to_ask(30.0 + TRUSTED_S + 0.1) == [b"one"]
    ended.add(b"one")
    assert side._endpoints_to_ask(40.0) == []
    assert not side._is_alive_since(runner, 10.0)
    runner.silent_since = None  # it answered
    assert side._endpoints_to_ask(41.0) == []
    assert not side._at_work
    assert not side._in_doubt


@pytest.mark.audit("dp-3")
def test_what_is_given_up_makes_room_for_those_that_wait(side: Any) -> None:
    """The server was full and silent, so nothing was due; what its requests leave free is."""
    runner = Mock()
    runner.name = "/plan"
    execution = ExecutionId(1)
    robot = NodeName("robot")
    side._calls[execution] = (runner, SimpleNamespace(id=execution, robot=robot, number=1))
    side._shares.take(robot)
    side._abandon(AbandonExecution(execution, robot, awaited=False))
    assert side._paced == {runner}


@pytest.mark.audit("dp-15")
def test_what_lies_at_a_server_that_stood_still_counts_when_it_goes_on() -> None:
    """Its queue holds ten: what it was handed before its silence is still in there."""
    runner: Any = ServiceRunner.__new__(ServiceRunner)
    runner._at_server = {}
    runner._alive_since = lambda _since: False
    runner.window = RequestWindow(alive_since=runner._alive_since)

    def ask(requests: range) -> list[int]:
        for request in requests:
            runner.window.add(request, Priority.NORMAL, 1e9, 1e9, 0.0)
        sent = []
        for request in runner.window.release(0.0):
            runner.window.sent(request, 0.0)
            sent.append(request)
        return sent

    assert ask(range(5)) == [0]
    assert runner.take_back_unsent() == [1, 2, 3, 4]
    assert ask(range(5, 9)) == []
    assert runner.take_back() == ([], [5, 6, 7, 8])
    assert ask(range(9, 12)) == [9]  # another server: nothing lies there


@pytest.mark.audit("dp-15")
@pytest.mark.parametrize(
    ("used", "ended", "chosen"),
    [
        ("b/srv/Used", set(), "b/srv/Used"),
        ("b/srv/Used", {b"stray"}, "b/srv/Used"),
        ("b/srv/Used", {b"used"}, "a/srv/Stray"),  # its process has ended, though DDS shows it for 20 s more
        ("b/srv/Used", {b"used", b"stray"}, "b/srv/Used"),
        (None, set(), "a/srv/Stray"),  # the same every time
        (None, {b"stray"}, "b/srv/Used"),
        ("c/srv/Nameless", set(), "a/srv/Stray"),  # a node that is not known serves it: it is none yet, or no more
    ],
)
def test_a_type_is_chosen_among_those_whose_servers_live(
    side: Any, monkeypatch: pytest.MonkeyPatch, used: str | None, ended: set[bytes], chosen: str
) -> None:
    shown = {"a/srv/Stray": {b"stray": True}, "b/srv/Used": {b"used": True}, "c/srv/Nameless": {b"nameless": False}}
    monkeypatch.setattr("plr.sidecar.ros.graph.graph.server_endpoints", lambda _node, _service, _name_of, _now: shown)
    watched: set[bytes] = set()
    side._loop = SimpleNamespace(node=None)
    side._processes = SimpleNamespace(watch=watched.add, has_ended=ended.__contains__)
    side._names = SimpleNamespace(name_of=lambda _endpoint, _now: None)
    side._several_types = set()
    nodes = {"a/srv/Stray": frozenset({"/stray"}), "b/srv/Used": frozenset({"/used"})}
    assert side._choose_type("/plan", used, nodes) == chosen
    assert watched == {b"stray", b"used", b"nameless"}
    assert side._several_types == (set() if ended else {"/plan"})
