"""A real control plane process with the CA of its fleet."""

from __future__ import annotations

import contextlib
import re
import time
import urllib.request
from typing import TYPE_CHECKING, Any

from plr.controlplane.ca import Authority
from plr.protos.trust.identity import IdentityRole
from tests.support.control_plane_process import PATIENCE_S, ControlPlaneProcess, Secured

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from plr.controlplane.ca import Validity


HOUR_S = 3600.0


class SecuredControlPlane(ControlPlaneProcess):
    """A secured control plane with the CA of its fleet."""

    def __init__(self, folder: Path, **changes: Any) -> None:
        self.authority = Authority.create()
        self.tls_dir = folder / "tls"
        self.authority.write_tls_dir(self.tls_dir, "control", IdentityRole.CONTROL_PLANE)
        self._issued: dict[str, Secured] = {}
        super().__init__(folder, tls_dir=str(self.tls_dir), **changes)

    def member(self, name: str, role: IdentityRole = IdentityRole.ROBOT, validity: Validity | None = None) -> Secured:
        """The certificate of this name, issued when it is first asked for."""
        if name not in self._issued:
            self._issued[name] = Secured(self.authority.issue(name, role, validity=validity), self.authority.ca_pem)
        return self._issued[name]

    def revoke(self, name: str) -> None:
        self.authority.revoke(name)
        self.install("crl.pem", self.authority.crl_pem())

    def install(self, file: str, content: bytes) -> None:
        """Put a file into its tls_dir and wait until it is in use."""
        taken = len(self.lines)
        part = self.tls_dir / "part"
        part.write_bytes(content)
        part.replace(self.tls_dir / file)
        self.wait_for_line("took new certificate files", after=taken)

    def count(self, metric: str) -> float:
        with urllib.request.urlopen(f"http://{self.metrics}/metrics", timeout=PATIENCE_S) as answer:
            found = re.search(rf"^{re.escape(metric)} (\S+)$", answer.read().decode(), re.MULTILINE)
        assert found is not None, metric
        return float(found[1])

    @contextlib.contextmanager
    def counted(self, reason: str, metric: str = "plr_refused_connections_total") -> Iterator[None]:
        """Within it, something is refused for this reason."""
        series = f'{metric}{{reason="{reason}"}}'
        before = self.count(series)
        yield
        end = time.monotonic() + PATIENCE_S
        while self.count(series) <= before:
            assert time.monotonic() < end, f"no {reason} counted"
            time.sleep(0.02)
