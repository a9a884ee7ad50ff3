"""The robots' accounts add up."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

import pytest

from examples.request_log import RequestLog, quantile

if TYPE_CHECKING:
    from pathlib import Path


def run_of(*latencies_ms: float | None, deadline_ms: float = 100.0) -> RequestLog:
    log = RequestLog("/service", deadline_ms)
    for index, latency_ms in enumerate(latencies_ms):
        record = log.sent(now=float(index), wall=1e9 + index)
        if latency_ms is not None:
            log.answered(record, index + latency_ms / 1e3)
    return log


def test_a_run_without_a_flaw() -> None:
    log = run_of(10, 20, 30)
    summary = log.summary()
    assert log.flawless()
    assert (summary["sent"], summary["answered_once"], summary["missing"]) == (3, 3, 0)
    assert summary["mean_ms"] == pytest.approx(20)
    assert summary["deadline_miss_ratio"] == 0


def test_no_request_is_no_success() -> None:
    log = run_of()
    assert not log.flawless()
    assert log.summary()["p99_ms"] is None


def test_a_missing_answer_is_a_missed_deadline() -> None:
    log = run_of(10, None, 150)
    assert not log.flawless()
    assert log.summary()["missing"] == 1
    assert log.summary()["deadline_missed"] == 2


def test_a_late_answer_is_no_flaw() -> None:
    assert run_of(10, 5_000).flawless()


def test_a_second_answer_counts_and_changes_no_latency() -> None:
    log = run_of(10, 20)
    log.answered(log.records[0], 99.0)
    assert log.summary()["answered_twice"] == 1
    assert log.summary()["answered_once"] == 1
    assert log.records[0].latency_ms == pytest.approx(10)
    assert not log.flawless()


def test_a_wrong_answer_and_a_stranger_are_flaws() -> None:
    wrong, stranger = run_of(10), run_of(10)
    wrong.records[0].problem = "path of another request"
    stranger.strangers += 1
    assert not wrong.flawless()
    assert not stranger.flawless()


def test_the_file_holds_every_request(tmp_path: Path) -> None:
    log = run_of(10, None)
    log.records[0].detail = {"people": 3.0}
    log.write_json(tmp_path / "run.json")
    content = json.loads((tmp_path / "run.json").read_text())
    assert content["summary"] == log.summary()
    assert content["requests"][0]["people"] == 3.0
    assert content["requests"][1] == {
        "index": 1,
        "sent_s": 1.0,
        "sent_wall_s": 1e9 + 1,
        "latency_ms": None,
        "answered": False,
        "answers": 0,
        "valid": False,
        "problem": None,
    }


def test_quantiles() -> None:
    values = [float(value) for value in range(1, 101)]
    assert quantile(values, 0.5) == 50
    assert quantile(values, 0.99) == 99
    assert quantile(values, 1.0) == 100
    assert quantile([], 0.5) is None
