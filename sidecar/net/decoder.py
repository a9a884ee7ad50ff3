"""The thread that decodes, so that no interface's own thread does: it would keep all other requests of that interface.

It takes slices of some milliseconds, from each peer in turn (`core/message/decoding.py`), with nothing locked; the
codec lets go of the interpreter as well.
"""

from __future__ import annotations

import logging
import threading
import time
from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    from sidecar.core.message.decoding import Decoding

log = logging.getLogger(__name__)

ERROR_PAUSE_S = 0.1
"""After an internal error, which may repeat itself at every turn."""


class DecodingOwner(Protocol):
    """Who has messages to decode; called on the decoder's thread."""

    def next_decoding(self) -> Decoding | None:
        """Return the message of which a slice is to be computed next."""

    def on_decoded(self, decoding: Decoding) -> None:
        """A message is computed."""

    def on_decoding_failed(self, decoding: Decoding) -> None:
        """A message can not be computed, for an internal error."""


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
        """End the thread, after the slice that it computes."""
        self._stopping = True
        self._wanted.set()
        self._thread.join(timeout_s)

    def wake(self) -> None:
        """There is something to decode; from any thread, nearly free while it is awake."""
        if not self._wanted.is_set():
            self._wanted.set()

    def _run(self) -> None:
        while not self._stopping:
            self._wanted.clear()  # before it looks: what comes from now on wakes it again
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
