"""Messages through a recorded path, first in, first out; and the folder that traces are read from."""

from __future__ import annotations

import json
import math
import random
from typing import TYPE_CHECKING

import pytest

from lab.errors import LabConfigError
from lab.profile import LinkProfile
from lab.trace_folder import read_folder
from lab.traces import TraceStep
from plr.controlplane.planning.fifo import FifoLink, FifoPath

if TYPE_CHECKING:
    from pathlib import Path

KBPS = 1000.0
"""125 bytes a millisecond."""


def steps(*rates: float, delay_ms: float = 10.0, loss: float = 0.0, queue: int = 100_000) -> tuple[TraceStep, ...]:
    profiles = [LinkProfile(delay_ms=delay_ms, loss=loss, rate_kbps=rate, queue_bytes=queue) for rate in rates]
    return tuple(TraceStep(float(at), profile, profile) for at, profile in enumerate(profiles))


def sent(link: FifoLink, *messages: tuple[float, int]) -> list[float]:
    rng = random.Random(0)
    return [link.send(at, size, rng) for at, size in messages]


def test_messages_take_their_size_at_the_rate_and_wait_for_those_before() -> None:
    link = FifoLink(steps(KBPS, KBPS), up=True)
    assert sent(link, (0.0, 12_500), (0.05, 12_500)) == pytest.approx([0.11, 0.21])


def test_an_outage_holds_messages_back_and_a_full_queue_drops_the_newest() -> None:
    link = FifoLink(steps(KBPS, 0.0, KBPS, queue=16_000), up=True)
    arrivals = sent(link, (0.95, 12_500), (1.5, 12_500), (1.6, 1250))
    assert arrivals == pytest.approx([2.06, math.inf, 2.07])


def test_the_end_of_the_trace_in_an_outage_loses_what_waits() -> None:
    assert sent(FifoLink(steps(KBPS, 0.0), up=True), (1.5, 1000)) == [math.inf]


def test_loss_costs_a_round_trip_or_twice_lost_the_message() -> None:
    always = FifoLink(steps(KBPS, loss=1.0), up=True)
    assert sent(always, (0.0, 1250)) == [math.inf]

    class Once(random.Random):
        draws = 0

        def random(self) -> float:
            self.draws += 1
            return 0.0 if self.draws == 1 else 0.99

    link = FifoLink(steps(KBPS, loss=0.5), up=True)
    assert link.send(0.0, 1250, Once()) == pytest.approx(0.01 + 0.01 + 2 * 0.01)


def test_a_request_goes_up_is_processed_and_comes_down() -> None:
    path = FifoPath(steps(KBPS, KBPS))
    assert path.request(0.0, 12_500, 1250, 0.02, random.Random(0)) == pytest.approx(0.11 + 0.02 + 0.02)


ENTRY = {"name": "t", "a": "one", "b": "two", "kind": "rate", "duration_s": 2.0}


def test_a_folder_is_read_by_its_index(tmp_path: Path) -> None:
    assert read_folder(tmp_path) == []
    (tmp_path / "index.json").write_text(json.dumps([ENTRY, {**ENTRY, "name": "s"}]))
    assert [(entry.name, entry.kind, entry.paths) for entry in read_folder(tmp_path)] == [
        ("s", "rate", ("one", "two")),
        ("t", "rate", ("one", "two")),
    ]
    with pytest.raises(LabConfigError, match=r"t\.csv\.gz"):
        read_folder(tmp_path)[1].load()


@pytest.mark.parametrize(
    ("index", "told"),
    [
        ("{", "index.json"),
        ("{}", "a list"),
        ("[1]", r"index.json\[0\]: expected an object"),
        (json.dumps([{**ENTRY, "kind": "x"}]), "rate or rtt"),
        (json.dumps([{**ENTRY, "name": "../t"}]), "no file name"),
        (json.dumps([{"name": "t", "kind": "rate"}]), "no 'a'"),
    ],
)
def test_a_folder_with_a_bad_index_is_refused(tmp_path: Path, index: str, told: str) -> None:
    (tmp_path / "index.json").write_text(index)
    with pytest.raises(LabConfigError, match=told):
        read_folder(tmp_path)
