"""Says whether a node's own certificate is in force, in words for the operator. Pure: the time is passed in."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from plr.protos.base.durations import in_words
from plr.protos.trust.identity import EXPIRED, NOT_YET_VALID, REVOKED, CertificateError

if TYPE_CHECKING:
    from plr.protos.program.tls_files import TlsFiles

SOON_S = 7 * 86_400.0
"""How long before its end a certificate gets a warning; the alert in deploy/prometheus fires as early."""

_REMEDIES = {
    EXPIRED: "renew it beside the CA, with: plr ca renew {name}, and copy cert.pem and key.pem to the node",
    NOT_YET_VALID: "set this host's clock if it is wrong, or wait",
    REVOKED: "let it in again beside the CA, with: plr ca issue {name} --role ..., and copy the files to the node",
}


@dataclass(frozen=True, slots=True)
class TermProblem:
    """A problem of a certificate, present or imminent."""

    in_force: bool
    """Whether peers still accept it."""
    text: str
    """One line: the file, what is wrong, what to do."""


def term_problem(files: TlsFiles, now_wall: float) -> TermProblem | None:
    """Return what the node's owner should know about its certificate at `now_wall` (seconds since 1970), or None."""
    path, name = files.directory / "cert.pem", files.identity.name
    try:
        files.trust.check(files.certificate_der, now_wall)
    except CertificateError as error:
        return TermProblem(in_force=False, text=f"{path}: nobody talks to this node: {with_remedy(error, name)}")
    left_s = files.identity.not_after - now_wall
    if left_s >= SOON_S:
        return None
    what_to_do = _REMEDIES[EXPIRED].format(name=name)
    return TermProblem(in_force=True, text=f"{path}: expires in {in_words(left_s)}; {what_to_do}")


def with_remedy(refusal: CertificateError, name: str) -> str:
    """Return why a node's certificate is refused and what to do about it, in one line."""
    return f"{refusal}; {remedy(refusal, name)}"


def remedy(refusal: CertificateError, name: str) -> str:
    """Return what to do about it."""
    return _REMEDIES.get(refusal.reason, "see docs/start/certificates.md").format(name=name)
