"""Keeps the event log, in memory and in a file that outlives the program.

    state_dir/events.jsonl   one event a line, JSON (`event_lines`); appended to
    state_dir/lock           held while the program runs, and touched: its time tells the next run when this one ended

The file is bounded: when it has grown to MAX_EVENT_FILE_BYTES it is rewritten from memory. It is also rewritten after a
failed write: a full disk costs nothing but time, as long as the program lives. Damaged lines (a power cut within one, a
bad sector) are skipped and counted. A thread of its own writes: a slow disk holds up nobody.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import logging
import os
import threading
import time
from bisect import bisect_left
from collections import deque
from typing import IO, TYPE_CHECKING, NamedTuple

from plr.controlplane.core.explain.event_memory import EventMemory
from plr.controlplane.core.overload.refusal_share import RefusalShare
from plr.controlplane.observe.event_lines import decode, encode
from plr.protos.base.errors import DecodeError
from plr.protos.model.fleet_events import EventKind, EventLogState, FleetEvent
from plr.protos.model.names import clean_text
from plr.protos.program import own_folder
from plr.protos.program.own_folder import OwnFolder

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from plr.protos.model.fleet_events import EventQuery, Why
    from plr.protos.model.ids import NodeName, Role

log = logging.getLogger(__name__)

FILE = "events.jsonl"
LOCK_FILE = "lock"

MAX_EVENT_FILE_BYTES = 8 << 20
"""Size at which the file is rewritten: the events in memory take half of it at most."""

MAX_UNWRITTEN = 4096
"""Events that may wait for the disk; beyond that the whole file is rewritten."""

RETRY_S = 10.0
"""Pause between a failed write and the next attempt."""

TOUCH_EVERY_S = 10.0
"""How precisely the next run knows when this one ended, if nothing happened shortly before."""

CLOSE_TIMEOUT_S = 2.0
"""Time limit for writing the last lines: a slow disk must not hold up a stop."""


PRESENCE = frozenset({EventKind.CONNECTED, EventKind.STREAM_LOST, EventKind.DEPARTED})
"""What `remembered` needs to know, after a restart, who was present and why others were gone."""


class _Said(NamedTuple):
    """An event as it was told."""

    at: float
    """Seconds since 1970."""
    kind: EventKind
    text: str
    role: Role | None
    why: Why | None
    seen_at: float | None


class EventLog:
    """Takes events on the loop's thread; without a folder it keeps them in memory only."""

    def __init__(
        self,
        folder: Path | None,
        *,
        wall: Callable[[], float] = time.time,
        clock: Callable[[], float] = time.monotonic,
        retry_s: float = RETRY_S,
    ) -> None:
        self._folder: OwnFolder | None = None
        self._path = folder
        self._wall = wall
        self._clock = clock
        self._retry_s = retry_s
        self._memory = EventMemory()
        self._refusals = RefusalShare()
        self._suppressed: dict[NodeName, int] = {}
        self._held: dict[NodeName, _Said] = {}
        """The last event of a member that says whether it is present, if that exceeds its share."""
        self._too_often = 0
        self._damaged = 0
        self._write_failures = 0
        self._problem = ""
        self._condition = threading.Condition()
        self._unwritten: deque[FleetEvent] = deque()
        self._write_all = False
        self._closing = False
        self._file: IO[bytes] | None = None
        self._lock: int | None = None
        """Descriptor of the lock file, or of the folder while that takes none."""
        self._writer: threading.Thread | None = None
        self.ran_until: float | None = None
        """When the previous run was last alive, in seconds since 1970; None if none is known."""
        if folder is None:
            return
        if self._open(folder):
            self._writer = threading.Thread(target=self._write, name="plr-events", daemon=True)
            self._writer.start()

    def announce(self) -> None:
        """Log what is wrong with the log; not at once, since a program that fails to start has other things to say."""
        if self._path is None:
            log.info("state_dir is not set: events are kept in memory only, and a restart forgets who is gone")
        elif self._problem:
            log.error("events are kept in memory only: %s", self._problem)
        if self._damaged:
            log.warning("%s: skipped %d damaged lines of the event log", self._path, self._damaged)

    # ── for the loop ──

    def record(
        self,
        kind: EventKind,
        node: NodeName | None = None,
        text: str = "",
        *,
        role: Role | None = None,
        why: Why | None = None,
        seen_s: float | None = None,
    ) -> None:
        """Record an event; `seen_s` is how long ago a departed member was last heard from."""
        at = self._wall()
        said = _Said(at, kind, text, role, why, at - seen_s if seen_s is not None else None)
        if node is None or self._memory.admits(node, self._clock(), presence=kind in PRESENCE):
            if node is not None and (held := self._held.pop(node, None)) is not None and kind not in PRESENCE:
                self._keep(node, held)
            self._keep(node, said)
            return
        if kind in PRESENCE:
            self._held[node] = said
        self._too_often += 1
        if node in self._suppressed or len(self._suppressed) < MAX_UNWRITTEN:
            self._suppressed[node] = self._suppressed.get(node, 0) + 1

    def record_refusal(self, node: NodeName, reason: str, text: str) -> None:
        """Record that a sidecar of this name was refused, now and then and not each time.

        This takes nothing of the share of a member of that name: it may be somebody else who uses the name.
        """
        left_out = self._refusals.take(node, reason, self._clock())
        if left_out is None:
            return
        if left_out:
            text = f"{text} (and {left_out} earlier times that were too many to keep)"
        self._add(_Said(self._wall(), EventKind.REFUSED, text, None, None, None), node)

    def keep_held(self) -> None:
        """Record the last change of presence of members that had more than their share, once there is room for it."""
        now = self._clock()
        for node in [node for node in self._held if self._memory.admits(node, now, presence=True)]:
            self._keep_held(node)

    def _keep_held(self, node: NodeName) -> None:
        self._too_often -= 1
        if self._suppressed.get(node, 0) > 1:
            self._suppressed[node] -= 1
        else:
            self._suppressed.pop(node, None)
        self._keep(node, self._held.pop(node))

    def _keep(self, node: NodeName | None, said: _Said) -> None:
        text = said.text
        if node is not None and (more := self._suppressed.pop(node, 0)):
            text = f"{text} (and {more} earlier events that were too many to keep)"
        self._add(said._replace(text=text), node)

    def _add(self, said: _Said, node: NodeName | None) -> None:
        # Numbers grow even after the log was lost: a client that asks for new events must not wait for a catch-up.
        number = max(self._memory.last_number + 1, int(self._wall() * 1e6))
        text = clean_text(said.text.strip())
        event = FleetEvent(number, said.at, said.kind, node, text, said.role, said.why, said.seen_at)
        with self._condition:
            self._memory.add(event)
            if self._writer is None:
                return
            self._unwritten.append(event)
            if len(self._unwritten) > MAX_UNWRITTEN:
                self._unwritten.clear()
                self._write_all = True
            self._condition.notify()

    def events(self) -> list[FleetEvent]:
        """Return all events in memory, the oldest first."""
        return list(self._memory)

    def last(self, count: int) -> list[FleetEvent]:
        """Return the last `count` events, the oldest first."""
        return self._memory.last(count)

    def find(self, query: EventQuery) -> tuple[list[FleetEvent], int]:
        """Return the events that match, the oldest first, and how many older ones `query.last` leaves out."""
        found = [
            event
            for event in self._memory
            if event.number > query.after
            and event.at >= query.since
            and (query.node is None or event.node == query.node)
        ]
        left_out = max(0, len(found) - query.last) if query.last else 0
        return found[left_out:], left_out

    @property
    def state(self) -> EventLogState:
        """State of the log."""
        return EventLogState(
            kept=len(self._memory),
            evicted=self._memory.evicted,
            too_often=self._too_often + self._refusals.left_out,
            damaged=self._damaged,
            write_failures=self._write_failures,
            on_disk=self._writer is not None and not self._problem,
            problem=self._problem,
        )

    def close(self) -> None:
        """Write what is still unwritten, if the disk takes it in time."""
        for node in list(self._held):
            self._keep_held(node)
        if self._writer is None:
            return
        with self._condition:
            self._closing = True
            self._condition.notify()
        self._writer.join(CLOSE_TIMEOUT_S)
        if not self._writer.is_alive():
            self._unlock()

    def _unlock(self) -> None:
        if self._lock is not None:
            os.close(self._lock)
            self._lock = None
        if self._folder is not None:
            self._folder.close()

    # ── the file ──

    def _open(self, path: Path) -> bool:
        try:
            self._folder = OwnFolder(path)
            self._lock = _open_lock(self._folder)
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            self._problem = f"state_dir: another control plane uses {path}; give each a folder of its own"
        except OSError as error:
            self._problem = f"state_dir: {path}: {error.strerror or error}"
        if self._problem:
            self._unlock()
            return False
        assert self._lock is not None
        assert self._folder is not None
        touched_at = os.fstat(self._lock).st_mtime
        try:
            for event in self._read(self._folder):
                self._memory.add(event)
        except FileNotFoundError:
            pass
        except OSError as error:
            log.error("%s cannot be read: %s; the event log starts empty", path / FILE, error.strerror or error)
        self._write_all |= self._damaged > 0
        last = self._memory.last(1)
        if last:
            self.ran_until = min(max(last[0].at, touched_at), self._wall())
        return True

    def _touch(self) -> None:
        assert self._lock is not None
        # A failure here loses no event; the next run then takes the last event for the end of this one.
        with contextlib.suppress(OSError, ValueError):
            at = self._wall()
            os.utime(self._lock, (at, at))

    def _open_to_append(self, name: str) -> IO[bytes]:
        assert self._folder is not None
        return open(self._folder.open(name, os.O_WRONLY | os.O_CREAT | os.O_APPEND), "ab", buffering=0)

    def _read(self, folder: OwnFolder) -> list[FleetEvent]:
        with folder.open_to_read(FILE) as file:
            size = file.seek(0, os.SEEK_END)
            file.seek(max(0, size - 2 * MAX_EVENT_FILE_BYTES))
            data = file.read(2 * MAX_EVENT_FILE_BYTES)
        # New lines must not be appended to a truncated one.
        self._write_all = not data.endswith(b"\n")
        read = []
        for line in data.split(b"\n"):
            if not line:
                continue
            try:
                read.append(decode(line))
            except DecodeError:
                self._damaged += 1
        events = _in_order(read)
        self._damaged += len(read) - len(events)
        return events

    # ── the writer's thread ──

    def _write(self) -> None:
        failed_at: float | None = None
        while True:
            self._touch()
            with self._condition:
                while not (self._closing or self._unwritten or self._write_all):
                    if not self._condition.wait(TOUCH_EVERY_S):
                        self._touch()
                if failed_at is not None and not self._closing:
                    # Everything waits for the disk; events that come meanwhile are written with the rest.
                    self._condition.wait_for(lambda: self._closing, self._retry_s)
                closing = self._closing
                whole = self._write_all or failed_at is not None
                events = list(self._memory) if whole else list(self._unwritten)
                self._unwritten.clear()
                self._write_all = False
            try:
                if events or whole:
                    self._put(events, whole)
            except OSError as error:
                failed_at = self._failed(error, told=failed_at is not None)
                with self._condition:
                    self._write_all = True
            else:
                if failed_at is not None:
                    log.info("events are written to the disk again")
                failed_at, self._problem = None, ""
            if closing:
                self._close_file()
                return

    def _failed(self, error: OSError, *, told: bool) -> float:
        self._write_failures += 1
        self._problem = f"{FILE}: {error.strerror or error}"
        if not told:
            log.error("%s cannot be written: %s; events stay in memory until it can", FILE, error.strerror or error)
        self._close_file()
        return self._clock()

    def _close_file(self) -> None:
        if self._file is not None:
            with contextlib.suppress(OSError):
                self._file.close()
            self._file = None

    def _put(self, events: list[FleetEvent], whole: bool) -> None:
        assert self._folder is not None
        data = "".join(f"{encode(event)}\n" for event in events).encode()
        if whole:
            self._close_file()
            self._folder.write(FILE, data)
            return
        if self._file is not None and not os.fstat(self._file.fileno()).st_nlink:
            raise FileNotFoundError(errno.ENOENT, "somebody has removed it")
        if self._file is None:
            self._file = self._open_to_append(FILE)
        own_folder.write_through(self._file, data)
        if self._file.tell() > MAX_EVENT_FILE_BYTES:
            with self._condition:
                self._write_all = True


def _open_lock(folder: OwnFolder) -> int:
    """Return what keeps a second control plane out.

    A disk that takes no file now, as it is full or read-only, still tells what was: later writes are tried again.
    """
    try:
        return folder.open(LOCK_FILE, os.O_WRONLY | os.O_CREAT | os.O_APPEND)
    except OSError as error:
        if error.errno not in {errno.EROFS, errno.ENOSPC, errno.EDQUOT}:
            raise
    with contextlib.suppress(FileNotFoundError):
        return folder.open(LOCK_FILE, os.O_RDONLY)
    return folder.open_itself()


def _in_order(events: list[FleetEvent]) -> list[FleetEvent]:
    """Return as many of these as are in ascending order of their numbers: one wrong number costs one event.

    Found by patience sorting (longest increasing subsequence).
    """
    ends: list[int] = []
    """The least number that ends such a sequence, for each length."""
    at: list[int] = []
    """The index of that event in `events`."""
    before: list[int | None] = []
    for index, event in enumerate(events):
        length = bisect_left(ends, event.number)
        before.append(at[length - 1] if length else None)
        if ends[length : length + 1] == [event.number]:
            # Of two events with the same number the first stays.
            continue
        ends[length : length + 1] = [event.number]
        at[length : length + 1] = [index]
    found = []
    next_one = at[-1] if at else None
    while next_one is not None:
        found.append(events[next_one])
        next_one = before[next_one]
    return found[::-1]
