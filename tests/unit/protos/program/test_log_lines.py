"""What peers say reaches a log only without what moves a cursor or begins a line."""

from __future__ import annotations

import io
import logging
import os
from typing import TYPE_CHECKING

import pytest

from plr.protos.base.printable import escaped
from plr.protos.program.log_lines import JournalFormatter, LineFormatter, is_journal, line_formatter
from plr.sidecar.core.base.values import RejectReason
from plr.sidecar.core.wire.messages import RejectionMessage, decode_message, encode_message
from tests.support.builders import request_id

if TYPE_CHECKING:
    from pathlib import Path

pytestmark = pytest.mark.audit("sec-11")

FORGED = "x\n2026-11-22T18:16:15.605Z INFO runtime: all is well\x1b[2J\x9b1A\u202e"


def line_of(text: str, *, exc_info: BaseException | None = None) -> str:
    trouble = None if exc_info is None else (type(exc_info), exc_info, None)
    record = logging.LogRecord("plr.sidecar.net.path_log", logging.WARNING, __file__, 1, "%s", (text,), trouble)
    record.created, record.msecs = 1767225600.25, 250.0
    return LineFormatter("plr.sidecar").format(record)


def test_a_line_is_what_it_was() -> None:
    assert line_of("path wlan0 to cloud-a is up: ä ✓") == (
        "2026-01-01T00:00:00.250Z WARNING net.path_log: path wlan0 to cloud-a is up: ä ✓"
    )


def test_nothing_that_is_said_is_more_than_text() -> None:
    line = line_of(FORGED)
    assert line.isprintable()
    assert r"x\n2026-11-22T18:16:15.605Z INFO runtime: all is well\x1b[2J\x9b1A\u202e" in line


def test_nor_in_a_traceback() -> None:
    first, *rest = line_of("failed", exc_info=ValueError(FORGED)).split("\n")
    assert first.endswith("failed")
    assert rest
    assert all(part.startswith("    ") and part.isprintable() for part in rest)


def test_every_control_character_is_escaped() -> None:
    for code in (*range(32), 127, *range(128, 160), 0x2028, 0x2029, 0x200E, 0x2066):
        assert escaped(f"a{chr(code)}b").isprintable()
        assert escaped(f"a{chr(code)}b") != "ab"


def test_a_rejections_words_are_printable() -> None:
    encoded = encode_message(RejectionMessage(request_id(1), 0, RejectReason.OVERLOADED, FORGED))
    decoded = decode_message(memoryview(b"".join(encoded)))
    assert isinstance(decoded, RejectionMessage)
    assert decoded.text.isprintable()


@pytest.mark.audit("ops-6")
def test_the_journal_gets_priorities_and_no_second_time() -> None:
    record = logging.LogRecord("plr.sidecar.net.path_log", logging.WARNING, __file__, 1, "is down", (), None)
    assert JournalFormatter("plr.sidecar").format(record) == "<4>net.path_log: is down"
    record.levelno = logging.CRITICAL
    record.exc_info = (ValueError, ValueError(FORGED), None)
    told = JournalFormatter("plr.sidecar").format(record).split("\n")
    assert len(told) > 1
    assert all(line.startswith("<2>") and line.isprintable() for line in told)


@pytest.mark.audit("ops-6")
def test_the_journal_is_known_by_its_stream(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with (tmp_path / "journal").open("w") as stream:
        status = os.fstat(stream.fileno())
        monkeypatch.setenv("JOURNAL_STREAM", f"{status.st_dev}:{status.st_ino + 1}")
        assert not is_journal(stream)
        assert not isinstance(line_formatter(stream), JournalFormatter)
        monkeypatch.setenv("JOURNAL_STREAM", f"{status.st_dev}:{status.st_ino}")
        assert isinstance(line_formatter(stream), JournalFormatter)
    assert not is_journal(io.StringIO())
