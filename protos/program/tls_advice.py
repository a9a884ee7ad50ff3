"""Explains gRPC's errors for failed TLS connections, and what to do about them. Pure: text in, text out."""

from __future__ import annotations

from typing import TYPE_CHECKING

from plr.protos.program.certificate_term import remedy
from plr.protos.trust.identity import CONTROL_PLANE_DNS, CertificateError

if TYPE_CHECKING:
    from plr.protos.program.tls_files import TlsFiles

_SEE_LOG = "see its log"


def explain(details: str, files: TlsFiles | None, now_wall: float) -> str | None:
    """Return one line for the operator, or None if TLS is not the cause.

    `details` says why a connection was never established, `files` is what the client presents (None: insecure), and
    `now_wall` is the time in seconds since 1970.
    """
    cut_off = "Socket closed" in details or "recvmsg:" in details
    if files is None:
        return (
            f"the control plane cut the connection: it may expect TLS, but this side has insecure: true; {_SEE_LOG}"
            if (cut_off)
            else None
        )
    if "WRONG_VERSION_NUMBER" in details:
        return "the control plane does not use TLS: it is insecure, or the port belongs to another program"
    if "CERTIFICATE_VERIFY_FAILED" in details:
        if "expired" in details or "not yet valid" in details:
            return "the control plane's certificate is not valid now: compare the clocks, or renew it (plr ca renew)"
        return (
            f"the control plane's certificate is not issued by a CA in {files.directory}/ca.pem: copy the ca.pem of "
            "the fleet's CA there"
        )
    if "Hostname Verification" in details or "is not in peer certificate" in details:
        return f"the peer is not a control plane: its certificate does not name {CONTROL_PLANE_DNS}"
    if not cut_off:
        return None
    try:
        files.trust.check(files.certificate_der, now_wall)
    except CertificateError as error:
        return f"{error}: the control plane refuses this node; {remedy(error, files.identity.name)}"
    return (
        "the control plane cut the connection during the TLS handshake: it may not know our CA, its clock may differ, "
        f"or it is insecure; {_SEE_LOG}"
    )
