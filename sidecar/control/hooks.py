"""Defines what the control client requires of the sidecar around it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    from plr.protos.model.mapping import MappingSet
    from plr.protos.model.members import PeerSet
    from plr.protos.model.report import Report
    from plr.protos.model.stream import Welcome
    from plr.protos.program.tls_files import TlsFiles
    from plr.sidecar.core.base.report_scope import ReportScope


class ControlHooks(Protocol):
    """The calls that the control client makes, on its own thread; they may wait there for the engine's lock."""

    def welcome(self, welcome: Welcome) -> None:
        """Take the welcome of an accepted stream, which also names the STUN servers."""

    def apply_peers(self, peers: PeerSet) -> str | None:
        """Put the peers in force; return why that failed, or None."""

    def apply_mapping(self, mapping: MappingSet) -> str | None:
        """Put the mapping in force; return why that failed, or None."""

    def take_report(self, scope: ReportScope) -> Report:
        """Return what was measured since the last call."""

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
