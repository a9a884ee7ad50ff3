"""Sets up logging for both programs: one line per event, with time, level and component, written by its own thread.

A journal or terminal that stalls must not stall the thread that logs. Lines wait in a bounded queue, and those that do
not fit are counted and reported afterwards.
"""

from __future__ import annotations

import contextlib
import logging
import os
import queue
from logging.handlers import QueueHandler, QueueListener
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from typing import TextIO

MAX_WAITING_LINES = 10_000
"""About 2 MB, some minutes of a busy log."""

STOP_TIMEOUT_S = 1.0
"""Time that a stalled stream may cost at the end of the program; waiting lines are then lost."""


class _BoundedQueueHandler(QueueHandler):
    """A handler that never blocks, and counts what it drops."""

    def __init__(self, waiting: queue.Queue[logging.LogRecord | None]) -> None:
        super().__init__(waiting)
        self._waiting = waiting
        self._dropped = 0

    def prepare(self, record: logging.LogRecord) -> logging.LogRecord:
        # Arguments may change before the line is written, so the text is formatted now.
        record.msg = record.getMessage()
        record.args = None
        return record

    def enqueue(self, record: logging.LogRecord) -> None:
        # Called under the handler's lock.
        try:
            if self._dropped:
                self._waiting.put_nowait(self._notice())
                self._dropped = 0
            self._waiting.put_nowait(record)
        except queue.Full:
            self._dropped += 1

    def tell_what_was_dropped(self) -> None:
        """Report dropped lines now, if there are any and there is room for it."""
        if self._dropped:
            with contextlib.suppress(queue.Full):
                self._waiting.put(self._notice(), timeout=STOP_TIMEOUT_S)

    def _notice(self) -> logging.LogRecord:
        text = f"{self._dropped} log lines were dropped"
        return logging.LogRecord(__name__, logging.WARNING, __file__, 0, text, None, None)


class _PatientListener(QueueListener):
    """A listener that ends even if its stream has stalled permanently."""

    def __init__(self, waiting: queue.Queue[logging.LogRecord | None], output: logging.Handler) -> None:
        super().__init__(waiting, output)
        self._waiting = waiting
        self.is_stalled = False
        """Whether its stream was still stalled when it was stopped."""

    def stop(self) -> None:
        if self._thread is None:
            return
        with contextlib.suppress(queue.Full):
            self._waiting.put(None, timeout=STOP_TIMEOUT_S)
        self._thread.join(STOP_TIMEOUT_S)
        self.is_stalled = self._thread.is_alive()
        self._thread = None


class Logging:
    """A context with the program's logging: `package` and protos log from `level` on, libraries from WARNING."""

    def __init__(
        self,
        package: str,
        level: str,
        stream: TextIO,
        formatter: logging.Formatter,
        *,
        max_waiting: int = MAX_WAITING_LINES,
    ) -> None:
        output = logging.StreamHandler(stream)
        output.setFormatter(formatter)
        waiting: queue.Queue[logging.LogRecord | None] = queue.Queue(max_waiting)
        self._handler = _BoundedQueueHandler(waiting)
        self._listener = _PatientListener(waiting, output)
        self._packages = (package, "plr.protos")
        self._level = level.upper()

    def __enter__(self) -> None:
        root = logging.getLogger()
        root.setLevel(logging.WARNING)
        root.addHandler(self._handler)
        for package in self._packages:
            logging.getLogger(package).setLevel(self._level)
        self._listener.start()

    def __exit__(self, *_: object) -> None:
        logging.getLogger().removeHandler(self._handler)
        self._handler.tell_what_was_dropped()
        self._listener.stop()

    def end_if_stalled(self, code: int) -> None:
        """Exit with this code, after the context, if its stream has stalled.

        The thread that hangs in a write holds locks that the interpreter takes at its end.
        """
        if self._listener.is_stalled:
            os._exit(code)
