"""Formats the log lines of both programs: UTC, level, component, text; no text of a peer can move a cursor.

systemd's journal notes the time itself. It gets a priority instead (sd-daemon(3)), so that `journalctl -p warning`
shows what it should.
"""

from __future__ import annotations

import logging
import os
import time
from typing import TYPE_CHECKING

from plr.protos.base.printable import escaped

if TYPE_CHECKING:
    from typing import TextIO

_PRIORITIES = {logging.CRITICAL: 2, logging.ERROR: 3, logging.WARNING: 4, logging.INFO: 6, logging.DEBUG: 7}
"""Priorities of syslog(3)."""


def line_formatter(stream: TextIO, own_package: str = "") -> logging.Formatter:
    """Return the formatter for this stream; `own_package` is left out before components' names."""
    return JournalFormatter(own_package) if is_journal(stream) else LineFormatter(own_package)


def is_journal(stream: TextIO) -> bool:
    """Return whether systemd's journal reads the stream: JOURNAL_STREAM identifies its file (systemd.exec(5))."""
    try:
        status = os.fstat(stream.fileno())
    except (OSError, ValueError):
        return False
    return os.environ.get("JOURNAL_STREAM") == f"{status.st_dev}:{status.st_ino}"


class LineFormatter(logging.Formatter):
    """2026-01-31T12:00:00.250Z WARNING control.client: text; a traceback follows on indented lines.

    Unprintable characters are escaped, as `repr` does: an escape sequence would move the cursor of a terminal that
    shows the log, and a line feed would begin a line that looks like one of ours.
    """

    def __init__(self, own_package: str = "") -> None:
        """Leave out `own_package` before the component's name, and `plr` before that of a shared one."""
        super().__init__()
        self._prefix = f"{own_package}." if own_package else ""

    def formatTime(self, record: logging.LogRecord, datefmt: str | None = None) -> str:
        """Return UTC in ISO 8601 with milliseconds."""
        seconds = time.strftime("%Y-%m-%dT%H:%M:%S", time.gmtime(record.created))
        return f"{seconds}.{int(record.msecs):03d}Z"

    def format(self, record: logging.LogRecord) -> str:
        """Return the line."""
        return f"{self.formatTime(record)} {record.levelname} {self._told(record)}"

    def _told(self, record: logging.LogRecord) -> str:
        component = record.name.removeprefix(self._prefix).removeprefix("plr.")
        line = f"{component}: {escaped(record.getMessage())}"
        if record.exc_info:
            trace = self.formatException(record.exc_info).split("\n")
            line += "".join(f"\n    {escaped(part)}" for part in trace)
        return line


class JournalFormatter(LineFormatter):
    """<4>control.client: text; each line has its priority, as the journal makes each an entry."""

    def format(self, record: logging.LogRecord) -> str:
        """Return the line."""
        priority = f"<{_PRIORITIES.get(record.levelno, 5)}>"
        return priority + self._told(record).replace("\n", f"\n{priority}")
