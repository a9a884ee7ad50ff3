"""Keeps the control plane's certificate files, and whoever they speak of, up to date while it runs."""

from __future__ import annotations

import asyncio
import logging
import ssl
from typing import TYPE_CHECKING, NoReturn

from protos.convert.fields import MAX_CRL_BYTES
from protos.errors import ConfigError
from protos.identity import IdentityRole
from protos.revocation_views import revocation_set
from protos.tls_files import POLL_INTERVAL_S, TlsFiles, TlsWatch, load_tls_files

if TYPE_CHECKING:
    from pathlib import Path

    from controlplane.loop import ControlLoop
    from controlplane.metrics import Metrics
    from controlplane.tls_gate import TlsGate
    from protos.clock_floor import ClockFloor

log = logging.getLogger(__name__)


def load_own_files(directory: Path) -> TlsFiles:
    """Return the control plane's own files; raises ConfigError."""
    files = load_tls_files(directory)
    role = files.identity.role
    if role is not IdentityRole.CONTROL_PLANE:
        problem = f"expected the certificate of a control plane, got a {role.value}'s; issue one: --role controlplane"
        raise ConfigError(str(directory), "", problem)
    return files


class CertificateKeeper:
    """Looks for new files and for the end of certificates, and tells the gate and the loop."""

    def __init__(self, files: TlsFiles, gate: TlsGate, loop: ControlLoop, metrics: Metrics, clock: ClockFloor) -> None:
        """`clock` is the gate's too."""
        self._clock = clock
        self._watch = TlsWatch(files)
        self._gate = gate
        self._loop = loop
        self._metrics = metrics
        metrics.own_certificate(files.identity, files.trust.lists())
        self._relay_revocations(files)

    async def run(self) -> NoReturn:
        """Run until cancelled."""
        while True:
            files = self._watch.poll()
            if files is not None:
                self._take(files)
            self._clock.note_lists(self._watch.current.trust)
            self._clock.note(self._watch.current.identity.not_before)
            now = self._clock.now()
            self._loop.end_expired(self._watch.current.trust, now)
            self._gate.end_expired(now)
            await asyncio.sleep(POLL_INTERVAL_S)

    def _take(self, files: TlsFiles) -> None:
        if files.identity.role is not IdentityRole.CONTROL_PLANE:
            log.error("the new certificate is a %s's: the old one stays in use", files.identity.role.value)
            return
        # The streams first: who is revoked shall hear so from gRPC before the connection is cut.
        self._loop.review(files.trust, self._clock.now())
        self._relay_revocations(files)
        try:
            self._gate.use(files)
        except ssl.SSLError as error:
            log.error("the new certificate is not used, the old one stays: %s", error)
            return
        self._metrics.own_certificate(files.identity, files.trust.lists())
        log.info("took new certificate files from %s", files.directory)

    def _relay_revocations(self, files: TlsFiles) -> None:
        crl = files.crl_pem or b""
        if len(crl) > MAX_CRL_BYTES:
            log.error("%s/crl.pem is longer than %d bytes: sidecars are not told of it", files.directory, MAX_CRL_BYTES)
            return
        self._loop.relay_revocations(crl, revocation_set(files.trust.lists()))
