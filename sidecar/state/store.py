"""Keeps on disk what a restart needs: who the sidecar is, and what the control plane said last.

Files are replaced whole (written aside, synced, renamed), so a power cut leaves either the old or the new one. A file
that cannot be read is set aside and counted; one that cannot be written is logged and retried. Neither keeps the
sidecar from running.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import logging
import os
import secrets
import threading
import time
from collections import Counter
from typing import TYPE_CHECKING, TypeVar

from plr.protos.base.errors import DecodeError
from plr.protos.model.members import TOKEN_BYTES
from plr.protos.program.own_folder import OwnFolder
from plr.protos.program.regular_file import open_regular
from plr.sidecar.state.file import (
    MAX_STATE_FILE_BYTES,
    ControlAddresses,
    LastGood,
    SavedIdentity,
    decode_addresses,
    decode_clock_floor,
    decode_identity,
    decode_last_good,
    decode_revocations,
    encode_addresses,
    encode_clock_floor,
    encode_identity,
    encode_last_good,
    encode_revocations,
)

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from plr.protos.model.ids import Address, NodeName
    from plr.protos.model.stream import ControlMessage

log = logging.getLogger(__name__)

IDENTITY_FILE = "identity"
LAST_GOOD_FILE = "last-good"
ADDRESSES_FILE = "control-addresses"
REVOCATIONS_FILE = "revocations"
CLOCK_FILE = "clock-floor"
LOCK_FILE = "lock"
SET_ASIDE_SUFFIX = ".refused"

FAILURES = (
    "identity_refused",
    "last_good_refused",
    "control_addresses_refused",
    "revocations_refused",
    "clock_floor_refused",
    "write_failed",
)
"""The keys of `StateStore.failures`."""

CLOSE_TIMEOUT_S = 2.0
"""How long `close` waits for the last write: a slow card must not hold up a shutdown."""

MIN_WRITE_INTERVAL_S = 1.0
"""Interval between two writes of the last messages: mappings may change several times a second, and flash wears out."""

RETRY_S = 10.0
"""Interval from a failed write to the next attempt: a full disk stays full for a while."""

T = TypeVar("T")


class StateDirError(OSError):
    """The folder cannot be used at all; the text says why."""


class StateStore:
    """One sidecar's folder, locked while open. Raises StateDirError when it cannot be used.

    `identity` has the same token in every run, but a larger incarnation.
    """

    def __init__(self, folder: Path, owner: NodeName) -> None:
        self._owner = owner
        self.failures: Counter[str] = Counter()
        """Counts of files not read or not written, by failure."""
        self._folder, self._lock = _lock(folder)
        self._dirty: dict[str, bytes | LastGood] = {}
        """Content to write, by file."""
        self._failing: set[str] = set()
        """Files whose last write failed and was logged."""
        self.identity = self._next_identity()
        self._current = self._read(LAST_GOOD_FILE, lambda data: decode_last_good(data, owner)) or LastGood(owner)
        self.last_good = self._current
        """As found on disk when opened."""
        self._addresses = self._read(ADDRESSES_FILE, decode_addresses) or ControlAddresses(())
        self.revocations = self._read(REVOCATIONS_FILE, decode_revocations) or b""
        """Revocation lists (PEM) as found on disk when opened."""
        self.clock_floor = self._read(CLOCK_FILE, decode_clock_floor) or 0.0
        """See `ClockFloor`; seconds since 1970, as found on disk when opened."""
        self._condition = threading.Condition()
        self._closing = False
        self._writer = threading.Thread(target=self._write_when_changed, name="plr-state", daemon=True)
        self._writer.start()

    def remember(self, message: ControlMessage) -> None:
        """Keep a message that is in force now in place of the last one of its kind; return at once."""
        with self._condition:
            changed = self._current.with_message(message)
            if changed != self._current:
                self._current = changed
                self._dirty[LAST_GOOD_FILE] = changed
                self._condition.notify()

    def control_addresses(self, names: tuple[str, ...]) -> tuple[Address, ...]:
        """Return the addresses where a control plane of these names accepted us, newest first."""
        return self._addresses.addresses if self._addresses.names == names else ()

    def remember_addresses(self, names: tuple[str, ...], addresses: tuple[Address, ...]) -> None:
        """Keep the addresses where a control plane of these names accepted us; return at once."""
        with self._condition:
            self._addresses = ControlAddresses(names, addresses)
            self._dirty[ADDRESSES_FILE] = encode_addresses(self._addresses)
            self._condition.notify()

    def remember_revocations(self, pem: bytes) -> None:
        """Keep the revocation lists in use; return at once."""
        with self._condition:
            self._dirty[REVOCATIONS_FILE] = encode_revocations(pem)
            self._condition.notify()

    def remember_clock_floor(self, floor: float) -> None:
        """Keep the time (s since 1970) before which the clock is not believed; return at once."""
        with self._condition:
            self._dirty[CLOCK_FILE] = encode_clock_floor(floor)
            self._condition.notify()

    def close(self) -> None:
        """Write what is not written yet, and release the folder."""
        with self._condition:
            self._closing = True
            self._condition.notify()
        self._writer.join(CLOSE_TIMEOUT_S)
        if self._writer.is_alive():
            log.warning("%s: the last state is still being written", self._folder.path)
        else:
            os.close(self._lock)
            self._folder.close()

    def _next_identity(self) -> SavedIdentity:
        known = self._read(IDENTITY_FILE, decode_identity)
        # Milliseconds since 1970 make the number grow even if the last one could not be read or written.
        incarnation = max(known.incarnation + 1 if known else 1, int(time.time() * 1000.0))
        identity = SavedIdentity(known.token if known else secrets.token_bytes(TOKEN_BYTES), incarnation)
        data = encode_identity(identity)
        if not self._write(IDENTITY_FILE, data):
            self._dirty[IDENTITY_FILE] = data
        return identity

    def _write_when_changed(self) -> None:
        while True:
            with self._condition:
                self._condition.wait_for(lambda: self._dirty or self._closing)
                if not self._dirty:
                    return
                closing = self._closing
                dirty, self._dirty = self._dirty, {}
            failed = {
                name: content
                for name, content in dirty.items()
                if not self._write(name, encode_last_good(content) if isinstance(content, LastGood) else content)
            }
            with self._condition:
                if closing and failed:
                    return
                # What arrived meanwhile is newer.
                self._dirty = failed | self._dirty
                self._condition.wait_for(lambda: self._closing, RETRY_S if failed else MIN_WRITE_INTERVAL_S)

    def _read(self, name: str, decode: Callable[[bytes], T]) -> T | None:
        path = self._folder.path / name
        try:
            with self._folder.open_to_read(name) as file:
                data = file.read(MAX_STATE_FILE_BYTES + 1)
            if len(data) > MAX_STATE_FILE_BYTES:
                raise DecodeError(f"more than {MAX_STATE_FILE_BYTES} bytes")
            return decode(data)
        except FileNotFoundError:
            return None
        except (OSError, DecodeError) as error:
            self.failures[f"{name.replace('-', '_')}_refused"] += 1
            log.error("%s is refused (%s) and set aside as %s", path, error, name + SET_ASIDE_SUFFIX)
            self._set_aside(name)
            return None

    def _set_aside(self, name: str) -> None:
        try:
            self._folder.rename(name, name + SET_ASIDE_SUFFIX)
        except OSError as error:
            log.error("%s cannot be set aside: %s", self._folder.path / name, error)

    def _write(self, name: str, data: bytes) -> bool:
        try:
            self._folder.write(name, data)
        except OSError as error:
            self.failures["write_failed"] += 1
            if name not in self._failing:
                self._failing.add(name)
                path = self._folder.path / name
                log.error(
                    "%s is not written: %s; the sidecar tries again, and a restart before that loses it", path, error
                )
            return False
        if name in self._failing:
            self._failing.remove(name)
            log.info("%s is written to the disk again", self._folder.path / name)
        return True


def peek_last_good(folder: Path, owner: NodeName) -> LastGood:
    """Return what the control plane said last, from files that a sidecar may be using; change nothing.

    It is empty if this user can read none. Files are replaced whole, so none is ever half written.
    """
    try:
        with open_regular(folder / LAST_GOOD_FILE) as file:
            data = file.read(MAX_STATE_FILE_BYTES + 1)
        return decode_last_good(data, owner)
    except (OSError, DecodeError):
        return LastGood(owner)


def _lock(path: Path) -> tuple[OwnFolder, int]:
    """Open the folder, and keep a second sidecar out of it while the returned descriptor is open."""
    try:
        folder = OwnFolder(path)
    except OSError as error:
        raise _unusable(error) from error
    try:
        descriptor = _open_lock(folder)
    except OSError as error:
        folder.close()
        raise _unusable(error) from error
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        os.close(descriptor)
        folder.close()
        raise StateDirError("expected a folder of its own: another sidecar is using it") from error
    return folder, descriptor


def _unusable(error: OSError) -> StateDirError:
    return StateDirError(f"expected a writable folder: {error.strerror or error}")


def _open_lock(folder: OwnFolder) -> int:
    try:
        return folder.open(LOCK_FILE, os.O_RDWR | os.O_CREAT)
    except OSError as error:
        # A card that has become read-only still holds the last mapping: the lock of an earlier run is enough. If it
        # never held any, the folder itself is locked, and the sidecar runs without state as with a full disk.
        with contextlib.suppress(FileNotFoundError):
            return folder.open(LOCK_FILE, os.O_RDONLY)
        if error.errno == errno.EROFS:
            return folder.open_itself()
        raise
