"""What the programs tell systemd of themselves (sd_notify(3)); without systemd, nothing."""

from __future__ import annotations

import sdnotify


class Notifier:
    """Never blocks: a status that finds no room is lost, the next one tells as much."""

    def __init__(self) -> None:
        self._systemd = sdnotify.SystemdNotifier()
        if self._systemd.socket is not None:
            self._systemd.socket.setblocking(False)
        self._status = ""

    def ready(self) -> None:
        """All is started."""
        self._systemd.notify("READY=1")

    def stopping(self) -> None:
        """The end has begun."""
        self._systemd.notify("STOPPING=1")

    def status(self, text: str) -> None:
        """Show how it is in `systemctl status`, if that is news."""
        if text != self._status:
            self._systemd.notify(f"STATUS={text}")
            self._status = text
