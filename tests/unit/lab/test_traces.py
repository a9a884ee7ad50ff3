"""Trace files, and when their steps apply."""

from __future__ import annotations

import gzip
from pathlib import Path  # noqa: TC003 - pytest reads the annotation of tmp_path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from lab.errors import LabConfigError
from lab.profile import LinkProfile
from lab.replay import Replay
from lab.traces import TraceStep, load_trace, parse_trace

HEADER = "t_s,a_up_kbps,a_down_kbps,a_rtt_ms,a_loss,b_up_kbps,b_down_kbps,b_rtt_ms,b_loss\n"
TEXT = HEADER + "0.0,100,200,60,0,300,400,52,0.5\n1.0,0,0,60,0,300,400,52,0\n"


def test_row_gives_each_direction_its_rate_and_half_the_round_trip() -> None:
    trace = parse_trace(TEXT, queue_bytes=360_000)
    assert trace.path("a")[0] == TraceStep(
        0.0,
        up=LinkProfile(delay_ms=30, rate_kbps=100, queue_bytes=360_000),
        down=LinkProfile(delay_ms=30, rate_kbps=200, queue_bytes=360_000),
    )
    assert trace.path("b")[0].up.loss == 0.5
    assert [step.at_s for step in trace.path("a")] == [0.0, 1.0]
    assert trace.duration_s == 2.0


def test_file_is_read_plain_and_compressed(tmp_path: Path) -> None:
    plain, packed = tmp_path / "t.csv", tmp_path / "t.csv.gz"
    plain.write_text(TEXT)
    packed.write_bytes(gzip.compress(TEXT.encode()))
    assert load_trace(plain) == load_trace(packed)
    assert load_trace(packed).name == "t"


def test_step_survives_json() -> None:
    step = parse_trace(TEXT).path("b")[0]
    assert TraceStep.from_json(step.to_json()) == step


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "columns"),
        ("t_s,a\n0,1\n", "columns"),
        (HEADER, "start at 0"),
        (HEADER + "1,1,1,1,0,1,1,1,0\n", "start at 0"),
        (HEADER + "0,1,1,1,0,1,1,1,0\n0,1,1,1,0,1,1,1,0\n", "start at 0"),
        (HEADER + "nan,1,1,1,0,1,1,1,0\n", "line 2"),
        (HEADER + "0,1,1,1,2,1,1,1,0\n", "line 2: a_loss"),
        (HEADER + "0,1,1,x,0,1,1,1,0\n", "line 2"),
        (HEADER + "0,1,1,1\n", "line 2"),
        (HEADER + "0,1,1,1,0,1,1,1,0,9\n", "line 2"),
    ],
)
def test_broken_trace_names_its_line(text: str, message: str) -> None:
    with pytest.raises(LabConfigError, match=message):
        parse_trace(text)


def test_unreadable_file_is_a_configuration_error(tmp_path: Path) -> None:
    broken = tmp_path / "broken.csv.gz"
    broken.write_bytes(gzip.compress(TEXT.encode())[:-9])
    for file in (broken, tmp_path / "missing.csv"):
        with pytest.raises(LabConfigError, match=file.name):
            load_trace(file)


def test_unknown_path_is_a_configuration_error() -> None:
    with pytest.raises(LabConfigError, match="no path 'c'"):
        parse_trace(TEXT).path("c")


lines = st.lists(st.text(st.sampled_from('0123456789.,-einaf"\x00 \n'), max_size=60), max_size=5)


@given(st.one_of(st.text(), lines.map(lambda rows: HEADER + "\n".join(rows))))
def test_any_text_is_a_trace_or_a_configuration_error(text: str) -> None:
    try:
        trace = parse_trace(text)
    except LabConfigError:
        return
    assert trace.path("a")[0].at_s == 0.0


STEPS = tuple(TraceStep(at, LinkProfile(delay_ms=at), LinkProfile()) for at in (0.0, 1.0, 2.5))


def given_out(replay: Replay, now: float) -> list[tuple[float, float]]:
    return [(at, step.up.delay_ms) for at, step in replay.due(now)]


def test_steps_apply_at_their_time_on_the_callers_clock() -> None:
    replay = Replay(STEPS, start=100.0)
    assert replay.next_change() == 100.0
    assert given_out(replay, 99.9) == []
    assert given_out(replay, 100.0) == [(100.0, 0.0)]
    assert given_out(replay, 100.5) == []
    assert given_out(replay, 101.2) == [(101.0, 1.0)]
    assert given_out(replay, 500.0) == [(102.5, 2.5)]
    assert replay.next_change() is None


def test_missed_steps_are_passed_over() -> None:
    assert given_out(Replay(STEPS, start=0.0), 10.0) == [(2.5, 2.5)]


def test_repeated_trace_starts_over_after_its_duration() -> None:
    replay = Replay(STEPS, start=0.0, repeat_s=4.0)
    assert given_out(replay, 3.0) == [(2.5, 2.5)]
    assert replay.next_change() == 4.0
    assert given_out(replay, 4.0) == [(4.0, 0.0)]
    assert replay.next_change() == 5.0


def test_senseless_replay_is_refused() -> None:
    with pytest.raises(LabConfigError, match="no steps"):
        Replay((), start=0.0)
    with pytest.raises(LabConfigError, match="repeat_s"):
        Replay(STEPS, start=0.0, repeat_s=2.5)
