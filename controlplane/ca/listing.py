"""Formats what a CA has issued as text for a terminal."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

from cryptography.x509.oid import NameOID

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from cryptography import x509

    from plr.controlplane.ca.index import Entry, Record

_HEADER = ("NAME", "ROLE", "SERIAL", "VALID UNTIL", "DAYS LEFT", "STATE")
_DAY_S = 86_400.0


def day(seconds: float) -> str:
    """Return the UTC day of a time in seconds since 1970."""
    return time.strftime("%Y-%m-%d", time.gmtime(seconds))


def render(records: Sequence[Record], certificates: Iterable[x509.Certificate], now_wall: float) -> str:
    """Return one row a certificate: the CAs, then the nodes by name, the newest of a name last."""
    rows = [_HEADER]
    for record, certificate in zip(records, certificates, strict=True):
        name = str(certificate.subject.get_attributes_for_oid(NameOID.COMMON_NAME)[0].value)
        end = certificate.not_valid_after_utc.timestamp()
        state = "expired" if now_wall > end else "in use" if record is records[0] else "former"
        rows.append((name, "CA", f"{record.serial:x}", day(end), _days_left(end, now_wall), state))
    entries = [entry for record in reversed(records) for entry in record.entries]
    newest = {entry.name: entry.serial for entry in entries}
    for entry in sorted(entries, key=lambda entry: entry.name):
        state = _state(entry, now_wall, newest=newest[entry.name] == entry.serial)
        end = entry.not_after
        left = "-" if entry.revoked_at is not None else _days_left(end, now_wall)
        rows.append((entry.name, entry.role.value, f"{entry.serial:x}", day(end), left, state))
    widths = [max(len(row[column]) for row in rows) for column in range(len(_HEADER))]
    return "\n".join(
        "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows
    )


def _state(entry: Entry, now_wall: float, *, newest: bool) -> str:
    if entry.revoked_at is not None:
        return f"revoked {day(entry.revoked_at)} ({entry.reason})"
    if now_wall > entry.not_after:
        return "expired"
    if now_wall < entry.not_before:
        return "not yet valid"
    return "valid" if newest else "valid, renewed"


def _days_left(end: float, now_wall: float) -> str:
    return f"{(end - now_wall) / _DAY_S:.1f}" if now_wall <= end else "-"
