"""Keeps the control plane's certificate files up to date while it runs, and re-checks the members they concern."""

from __future__ import annotations

import asyncio
import logging
import ssl
from typing import TYPE_CHECKING, NoReturn

from plr.protos.base.errors import ConfigError
from plr.protos.convert.fields import MAX_CRL_BYTES
from plr.protos.program.tls_files import POLL_INTERVAL_S, TlsFiles, TlsWatch, load_tls_files
from plr.protos.trust.identity import IdentityRole
from plr.protos.trust.revocation_views import revocation_set

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from plr.controlplane.loop import ControlLoop
    from plr.controlplane.observe.metrics import Metrics
    from plr.controlplane.serve.tls_gate import TlsGate
    from plr.protos.model.ids import NodeName
    from plr.protos.trust.clock_floor import ClockFloor

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
    """Watches for new files and expired certificates, and has the gate and the loop check members again.

    Checking a certificate takes a few tenths of a millisecond, and a change concerns everybody. Members are therefore
    checked in turns of the loop, those named in a revocation list first. The stream of a member comes before its
    connections, so that a revoked one learns the reason from gRPC before it is cut off. New connections are checked by
    the new files at once.
    """

    def __init__(self, files: TlsFiles, gate: TlsGate, loop: ControlLoop, metrics: Metrics, clock: ClockFloor) -> None:
        """Watch `files`; `clock` is shared with the gate."""
        self._clock = clock
        self._watch = TlsWatch(files)
        self._gate = gate
        self._loop = loop
        self._metrics = metrics
        self._unfit = False
        """Whether the folder's files are complete, but TLS refuses them."""
        self._unjudged: dict[NodeName, None] = {}
        """Members still to be checked, in order."""
        self._something_to_judge = asyncio.Event()
        metrics.own_certificate(files.identity, files.trust.lists())
        self._relay_revocations(files)

    async def run(self) -> NoReturn:
        """Run until cancelled."""
        async with asyncio.TaskGroup() as tasks:
            tasks.create_task(self._review())
            while True:
                files = self._watch.poll()
                if files is not None:
                    self._take(files)
                self._metrics.files_refused = self._unfit or self._watch.refused is not None
                trust = self._watch.current.trust
                self._clock.note_lists(trust)
                self._clock.note(self._watch.current.identity.not_before)
                now = self._clock.now()
                self._judge(dict.fromkeys([*self._loop.ended(now), *self._gate.ended(now)]))
                await asyncio.sleep(POLL_INTERVAL_S)
        raise AssertionError("it ends by being cancelled")

    def _take(self, files: TlsFiles) -> None:
        self._unfit = True
        self._relay_revocations(files)
        try:
            self._gate.use(files)
        except ssl.SSLError as error:
            log.error("the new certificate is refused; the old one stays in use: %s", error)
        else:
            self._unfit = False
            self._metrics.own_certificate(files.identity, files.trust.lists())
            log.info("took new certificate files from %s", files.directory)
        everybody = [*self._loop.serials(), *self._gate.serials()]
        named = dict.fromkeys(name for name, serial in everybody if files.trust.revokes(serial))
        # Members left over from the change before come before those checked already: however often the files change,
        # everybody's turn comes.
        self._judge(named | self._unjudged | dict.fromkeys(name for name, _ in everybody))

    def _judge(self, names: dict[NodeName, None]) -> None:
        """Check these members, and then all others still to be checked."""
        if names:
            self._unjudged = names | self._unjudged
            self._something_to_judge.set()

    async def _review(self) -> NoReturn:
        while True:
            await self._something_to_judge.wait()
            self._something_to_judge.clear()
            async for _ in self._loop.turns.each(self._next_unjudged(), self._review_one):
                pass

    def _next_unjudged(self) -> Iterator[NodeName]:
        while self._unjudged:
            name = next(iter(self._unjudged))
            del self._unjudged[name]
            yield name

    def _review_one(self, name: NodeName) -> None:
        self._loop.review(name, self._watch.current.trust, self._clock.now())
        self._gate.review(name)

    def _relay_revocations(self, files: TlsFiles) -> None:
        crl = files.crl_pem or b""
        if len(crl) > MAX_CRL_BYTES:
            log.error("%s/crl.pem is longer than %d bytes: sidecars do not get it", files.directory, MAX_CRL_BYTES)
            return
        self._loop.relay_revocations(crl, revocation_set(files.trust.lists()))
