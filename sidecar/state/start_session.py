"""Begins this run's session with a fresh key, which never leaves memory, and the credential that names its owner."""

from __future__ import annotations

import math
import os
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from plr.protos.base.errors import ConfigError
from plr.protos.trust.credential import Aead, SessionCredential, session_number, verify
from plr.sidecar.core.crypto.session import OwnSession, public_key
from plr.sidecar.core.wire.introduction import MAX_INTRODUCED_BYTES

if TYPE_CHECKING:
    from collections.abc import Callable

    from plr.protos.model.ids import NodeName, Role
    from plr.protos.program.tls_files import TlsFiles
    from plr.protos.trust.clock_floor import ClockFloor
    from plr.protos.trust.identity import Identity

PRIVATE_KEY_BYTES = 32
CPUINFO = Path("/proc/cpuinfo")


def start_session(
    name: NodeName,
    role: Role,
    incarnation: int,
    tls: Callable[[], TlsFiles] | None,
    clock: ClockFloor,
    max_revocation_age_s: float = math.inf,
) -> OwnSession:
    """Return a new session. `tls` returns the current certificate, key and trust; None means insecure mode.

    `clock` is used to judge peers. A peer whose CA signed no revocation list in the last `max_revocation_age_s` is not
    believed.

    Raises:
        ConfigError: the certificate is too long for introductions.
    """
    private_key = os.urandom(PRIVATE_KEY_BYTES)
    public = public_key(private_key)
    session = session_number(name, role, public)
    credential = SessionCredential(name, role, session, incarnation, public, preferred_aead())
    if tls is None:
        return OwnSession(credential, private_key, _take_as_it_is)

    def judge(theirs: SessionCredential) -> float:
        def check(certificate: bytes) -> Identity:
            return tls().trust.check(certificate, clock.now(), max_revocation_age_s)

        identity = verify(theirs, check)
        clock.note(identity.not_before)
        return identity.not_after

    return OwnSession(signed(credential, tls()), private_key, judge)


def signed(credential: SessionCredential, tls: TlsFiles) -> SessionCredential:
    """Return the credential with this certificate, signed, for a new session or a renewed certificate."""
    new = replace(credential, certificate=tls.certificate_der).sign(tls.private_key)
    if len(new.encode()) > MAX_INTRODUCED_BYTES:
        problem = f"expected a certificate at least {len(new.encode()) - MAX_INTRODUCED_BYTES} bytes shorter"
        raise ConfigError(str(tls.directory / "cert.pem"), "", problem)
    return new


def preferred_aead() -> Aead:
    """Return the cipher that is faster on this machine: AES where the processor has instructions for it."""
    try:
        lines = CPUINFO.read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        return Aead.CHACHA20_POLY1305
    words = {word for line in lines if line.startswith(("flags", "Features")) for word in line.split()}
    return Aead.AES_256_GCM if "aes" in words else Aead.CHACHA20_POLY1305


def _take_as_it_is(credential: SessionCredential) -> float:
    """Accept a credential in insecure mode: whatever the control plane says is believed, forever."""
    return math.inf
