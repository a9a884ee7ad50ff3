"""Defines what the control client requires of the sidecar around it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    from plr.protos.model.mapping import MappingSet
    from plr.protos.model.members import PeerSet
    from plr.protos.model.stream import Welcome
    from plr.protos.program.tls_files import TlsFiles


class ControlHooks(Protocol):
    """The calls that the control client makes, on its own thread; they may wait there for the engine's lock."""

    def welcome(self, welcome: Welcome) -> None:
        """Take the welcome of an accepted stream, which also names the STUN servers."""

    def applied(self, content: PeerSet | MappingSet) -> None:
        """Note that the data plane has put these peers or this mapping in force."""

    def connection_changed(self, connected: bool, reason: str) -> None:
        """Note that the control plane was reached or lost."""

    def look_at_revocations(self) -> None:
        """Judge the revocation lists that peers sent, and the age of those in use; called every second."""

    def end_expired(self) -> None:
        """Drop peers whose certificates have expired by now."""

    def judge_again(self) -> None:
        """Judge refused peers again: time has passed or our clock was set, so they may be good now."""

    def certificate_changed(self, files: TlsFiles) -> None:
        """Take the new certificate files, which are in use from now on; the session uses them to register next time."""
