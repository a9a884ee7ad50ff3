"""Prepares TLS handshakes, and says why one failed: a word for the metrics and a text for the log."""

from __future__ import annotations

import os
import ssl
from typing import TYPE_CHECKING

from plr.protos.trust.identity import UNTRUSTED

if TYPE_CHECKING:
    from plr.protos.program.tls_files import TlsFiles

NO_CERTIFICATE = "no_certificate"
OLD_TLS = "old_tls"
NOT_TLS = "not_tls"
CLIENT_REFUSED = "client_refused"
HANDSHAKE_TIMEOUT = "handshake_timeout"
HANDSHAKE_ABORTED = "handshake_aborted"
HANDSHAKE_FAILED = "handshake_failed"

_SSL_REASONS = {
    "PEER_DID_NOT_RETURN_A_CERTIFICATE": (NO_CERTIFICATE, "the client presents no certificate"),
    "UNSUPPORTED_PROTOCOL": (OLD_TLS, "the client does not use TLS 1.3"),
    "NO_PROTOCOLS_AVAILABLE": (OLD_TLS, "the client does not use TLS 1.3"),
    "WRONG_VERSION_NUMBER": (NOT_TLS, "the client does not use TLS"),
    "PACKET_LENGTH_TOO_LONG": (NOT_TLS, "the client does not use TLS"),
    "HTTP_REQUEST": (NOT_TLS, "the client does not use TLS"),
    "HTTPS_PROXY_REQUEST": (NOT_TLS, "the client does not use TLS"),
}


NO_CHECK_TIME = ssl.VerifyFlags(0x20_0000)
"""X509_V_FLAG_NO_CHECK_TIME of OpenSSL, which the `ssl` module does not name. The gate itself checks the validity
periods, by the clock's floor, and can say whose certificate has expired."""


def server_context(files: TlsFiles) -> ssl.SSLContext:
    """Return a context that accepts TLS 1.3 from holders of a certificate of these CAs, and nothing else.

    Raises:
        ssl.SSLError: OpenSSL refuses the files.
    """
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.minimum_version = ssl.TLSVersion.TLSv1_3
    context.verify_mode = ssl.CERT_REQUIRED
    context.verify_flags |= NO_CHECK_TIME
    # Every connection presents its certificate: the check of a resumed session would be as old as its first handshake.
    context.options |= ssl.OP_NO_TICKET
    context.num_tickets = 0
    context.set_alpn_protocols(["h2"])
    context.load_verify_locations(cadata=files.ca_pem.decode("ascii"))
    _load_key(context, files)
    return context


def _load_key(context: ssl.SSLContext, files: TlsFiles) -> None:
    """Load the key in memory, which was checked, although the `ssl` module reads keys from files only."""
    handle = os.memfd_create("plr-key")
    try:
        os.write(handle, files.certificate_pem + b"\n" + files.key_pem)
        context.load_cert_chain(f"/proc/self/fd/{handle}")
    finally:
        os.close(handle)


def why_failed(error: Exception) -> tuple[str, str]:
    """Return the reason and a text for a handshake that failed with this error."""
    if isinstance(error, ssl.SSLCertVerificationError):
        return UNTRUSTED, f"the client's certificate: {error.verify_message}"
    if isinstance(error, ssl.SSLError):
        reason = str(error.reason or "")
        if "_ALERT_" in reason:
            return CLIENT_REFUSED, f"the client refuses us: {_words(reason.partition('_ALERT_')[2])}"
        return _SSL_REASONS.get(reason, (HANDSHAKE_FAILED, _words(reason) or str(error)))
    if isinstance(error, ConnectionAbortedError | TimeoutError):
        return HANDSHAKE_TIMEOUT, "the client did not finish the TLS handshake"
    return HANDSHAKE_ABORTED, "the client ended the connection during the TLS handshake"


def _words(reason: str) -> str:
    return reason.replace("_", " ").lower()
