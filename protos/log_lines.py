"""How both programs write a log line: UTC, level, component, text; nothing that a peer says moves a cursor."""

from __future__ import annotations

import logging
import time


class LineFormatter(logging.Formatter):
    """2026-01-31T12:00:00.250Z WARNING control_client: text; a traceback follows on indented lines.

    What is not printable is written as an escape, as `repr` does: an escape sequence would move the cursor of whoever
    reads the log in a terminal, and a line feed would begin a line that looks like one of ours.
    """

    def __init__(self, own_package: str = "") -> None:
        """`own_package` is left out before the component's name."""
        super().__init__()
        self._prefix = f"{own_package}." if own_package else ""

    def formatTime(self, record: logging.LogRecord, datefmt: str | None = None) -> str:
        """Return UTC in ISO 8601 with milliseconds."""
        seconds = time.strftime("%Y-%m-%dT%H:%M:%S", time.gmtime(record.created))
        return f"{seconds}.{int(record.msecs):03d}Z"

    def format(self, record: logging.LogRecord) -> str:
        """Return the line."""
        component = record.name.removeprefix(self._prefix)
        line = f"{self.formatTime(record)} {record.levelname} {component}: {escaped(record.getMessage())}"
        if record.exc_info:
            trace = self.formatException(record.exc_info).split("\n")
            line += "".join(f"\n    {escaped(part)}" for part in trace)
        return line


def escaped(text: str) -> str:
    """`text` on one line, with escapes in place of what is not printable."""
    if text.isprintable():
        return text
    return "".join(char if char.isprintable() else repr(char)[1:-1] for char in text)
