"""What the control client asks of the sidecar around it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    from protos.model.mapping import MappingSet
    from protos.model.members import PeerSet
    from protos.model.report import Report
    from protos.model.stream import Welcome
    from protos.program.tls_files import TlsFiles
    from sidecar.core.base.report_scope import ReportScope


class ControlHooks(Protocol):
    """What the control client calls, on its own thread; it may wait there for the engine's lock."""

    def welcome(self, welcome: Welcome) -> None:
        """A stream is accepted; also the place of the STUN servers."""

    def apply_peers(self, peers: PeerSet) -> str | None:
        """Put the peers in force; returns why not, or None."""

    def apply_mapping(self, mapping: MappingSet) -> str | None:
        """Put the mapping in force; returns why not, or None."""

    def take_report(self, scope: ReportScope) -> Report:
        """Return what was measured since the last call."""

    def connection_changed(self, connected: bool, reason: str) -> None:
        """The control plane came within reach, or went out of it."""

    def look_at_revocations(self) -> None:
        """A second has passed: judge the revocation lists that peers sent, and how old those in use are."""

    def end_expired(self) -> None:
        """Part with peers whose certificates have ended by now."""

    def judge_again(self) -> None:
        """Time has passed, or our clock was set: refused peers may be good now."""

    def certificate_changed(self, files: TlsFiles) -> None:
        """New certificate files are in use from now on; the session tells the next registration of them."""
