"""A mesh whose nodes have certificates of one CA, as in a fleet: what they say is signed, and what they hear judged."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

from lab.simulated.mesh import Mesh
from plr.controlplane.ca import Authority
from plr.controlplane.ca.files import write_tls_files
from plr.protos.program.tls_files import load_tls_files
from plr.protos.trust.clock_floor import ClockFloor
from plr.protos.trust.identity import IdentityRole
from plr.sidecar.control.announcement import Announcer
from plr.sidecar.state.start_session import signed, start_session

if TYPE_CHECKING:
    from pathlib import Path

    from lab.simulated.mesh import Node
    from plr.protos.program.tls_files import TlsFiles
    from plr.protos.trust.credential import SessionCredential
    from plr.sidecar.core.crypto.session import OwnSession


class CertifiedMesh(Mesh):
    """Nodes begin their sessions as the program does."""

    def __init__(self, seed: int, folder: Path) -> None:
        super().__init__(seed)
        self._folder = folder
        self._authority = Authority.create()
        self.files: dict[str, TlsFiles] = {}
        self.clock = ClockFloor(time.time)
        self.begin_session = self._begin_certified

    def renew(self, node: Node) -> SessionCredential:
        """Give it another certificate; returns the credential of its session signed with that."""
        path, authority = self._folder / node.name, self._authority
        write_tls_files(path, authority.renew(node.name), authority.ca_pem, authority.crl_pem())
        self.files[node.name] = load_tls_files(path)
        return signed(node.own.credential, self.files[node.name])

    def _begin_certified(self, node: Node) -> tuple[OwnSession, Announcer]:
        if node.name not in self.files:
            path = self._folder / node.name
            self._authority.write_tls_dir(path, node.name, IdentityRole(node.role.value))
            self.files[node.name] = load_tls_files(path)
        own = start_session(node.name, node.role, node.incarnation, lambda: self.files[node.name], self.clock)
        return own, Announcer(own.credential.session, lambda: self.files[node.name], lambda _: ())
