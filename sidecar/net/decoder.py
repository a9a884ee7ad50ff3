"""Decodes messages on a thread of its own: an interface's thread would hold up all other requests of that interface.

It computes slices of some milliseconds, for each peer in turn (`core/message/decoding.py`), with nothing locked; the
codec releases the interpreter as well.
"""

from __future__ import annotations

import logging
import threading
import time
from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    from plr.sidecar.core.message.decoding import Decoding

log = logging.getLogger(__name__)

ERROR_PAUSE_S = 0.1
"""Pause after an internal error, which may recur at every turn."""


class DecodingOwner(Protocol):
    """The owner of messages to decode; called on the decoder's thread."""

    def next_decoding(self) -> Decoding | None:
        """Return the message whose next slice is to be computed."""

    def on_decoded(self, decoding: Decoding) -> None:
        """Take a message whose decoding is complete."""

    def on_decoding_failed(self, decoding: Decoding) -> None:
        """Give up a message that cannot be decoded because of an internal error."""


class Decoder:
    """One thread for the messages of all interfaces."""

    def __init__(self, owner: DecodingOwner) -> None:
        self._owner = owner
        self._wanted = threading.Event()
        self._stopping = False
        self._thread = threading.Thread(target=self._run, name="plr-decoder", daemon=True)

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def stop(self, timeout_s: float) -> None:
        """End the thread after the slice that it is computing."""
        self._stopping = True
        self._wanted.set()
        self._thread.join(timeout_s)

    def wake(self) -> None:
        """Wake the thread to decode; from any thread, nearly free while it is awake."""
        if not self._wanted.is_set():
            self._wanted.set()

    def _run(self) -> None:
        while not self._stopping:
            self._wanted.clear()  # before it looks: later messages wake it again
            decoding = self._owner.next_decoding()
            if decoding is not None:
                self._guarded_slice(decoding)
            elif not self._stopping:
                self._wanted.wait()

    def _guarded_slice(self, decoding: Decoding) -> None:
        try:
            if decoding.run_slice():
                self._owner.on_decoded(decoding)
        except Exception:
            log.exception("internal error; one message of %s is lost", decoding.path.peer)
            self._owner.on_decoding_failed(decoding)
            time.sleep(ERROR_PAUSE_S)
