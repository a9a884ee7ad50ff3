"""Tells systemd the state of the program (sd_notify(3)); without systemd it does nothing."""

from __future__ import annotations

import sdnotify


class Notifier:
    """Sends without blocking: a status that finds no room is lost, and the next one replaces it."""

    def __init__(self) -> None:
        self._systemd = sdnotify.SystemdNotifier()
        if self._systemd.socket is not None:
            self._systemd.socket.setblocking(False)
        self._status = ""

    def ready(self) -> None:
        """Report that the start is complete."""
        self._systemd.notify("READY=1")

    def stopping(self) -> None:
        """Report that the end has begun."""
        self._systemd.notify("STOPPING=1")

    def status(self, text: str) -> None:
        """Show a status in `systemctl status`, if it is new."""
        if text != self._status:
            self._systemd.notify(f"STATUS={text}")
            self._status = text
