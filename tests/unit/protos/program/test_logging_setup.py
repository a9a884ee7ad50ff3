from __future__ import annotations

import io
import logging
import re
import threading
from typing import TYPE_CHECKING

import pytest

from plr.protos.program import logging_setup
from plr.protos.program.log_lines import line_formatter
from plr.protos.program.logging_setup import Logging

if TYPE_CHECKING:
    from collections.abc import Iterator

OURS = logging.getLogger("plr.sidecar.net.sockets")
LINE = re.compile(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d\.\d{3}Z [A-Z]+ \S+: .*")


def logging_to(stream: io.StringIO, level: str, max_waiting: int = logging_setup.MAX_WAITING_LINES) -> Logging:
    return Logging("plr.sidecar", level, stream, line_formatter(stream, "plr.sidecar"), max_waiting=max_waiting)


@pytest.fixture(autouse=True)
def _levels() -> Iterator[None]:
    loggers = [logging.getLogger(name) for name in (None, "plr.sidecar", "plr.protos")]
    levels = [logger.level for logger in loggers]
    yield
    for logger, level in zip(loggers, levels, strict=True):
        logger.setLevel(level)


def test_one_line_with_time_level_and_component() -> None:
    stream = io.StringIO()
    with logging_to(stream, "info"):
        OURS.info("hello %s", "there")
        OURS.warning("two\nlines")
        OURS.debug("too quiet")
    first, second = stream.getvalue().splitlines()
    assert LINE.fullmatch(first)
    assert first.endswith("Z INFO net.sockets: hello there")
    assert second.endswith("Z WARNING net.sockets: two\\nlines")


def test_libraries_are_heard_from_warning_on() -> None:
    stream = io.StringIO()
    with logging_to(stream, "debug"):
        logging.getLogger("asyncio").info("chatter")
        logging.getLogger("asyncio").warning("trouble")
        OURS.debug("detail")
    assert [line.split(": ")[1] for line in stream.getvalue().splitlines()] == ["trouble", "detail"]


def test_a_traceback_follows_its_line_indented() -> None:
    stream = io.StringIO()
    with logging_to(stream, "info"):
        try:
            raise ValueError("broken")
        except ValueError:
            OURS.exception("failed")
    first, *rest = stream.getvalue().splitlines()
    assert LINE.fullmatch(first)
    assert all(line.startswith("    ") for line in rest)
    assert rest[-1].strip() == "ValueError: broken"


def test_arguments_are_written_as_they_were() -> None:
    stream = io.StringIO()
    values = [1]
    with logging_to(stream, "info"):
        OURS.info("values %s", values)
        values.append(2)
    assert "values [1]" in stream.getvalue()


class StalledStream(io.StringIO):
    """A terminal that takes nothing until it is let go."""

    def __init__(self) -> None:
        super().__init__()
        self.go = threading.Event()

    def write(self, text: str) -> int:
        self.go.wait()
        return super().write(text)


def test_a_stalled_stream_does_not_stall_who_logs_and_the_loss_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(logging_setup, "STOP_TIMEOUT_S", 30.0)
    stream = StalledStream()
    with logging_to(stream, "info", max_waiting=5):
        for number in range(50):
            OURS.info("line %d", number)
        stream.go.set()
    text = stream.getvalue()
    # Told more than once when the writer's thread takes its first line only after some were dropped.
    dropped = sum(int(told) for told in re.findall(r"WARNING \S+: (\d+) log lines were dropped", text))
    assert dropped > 40
    assert dropped + text.count(": line ") == 50


def test_a_stream_stalled_permanently_does_not_keep_the_program_from_ending(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(logging_setup, "STOP_TIMEOUT_S", 0.05)
    stream = StalledStream()
    with logging_to(stream, "info", max_waiting=2):
        for number in range(9):
            OURS.info("line %d", number)
    assert stream.getvalue() == ""
    stream.go.set()
