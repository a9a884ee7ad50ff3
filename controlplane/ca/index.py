"""Records what a CA has issued and revoked, and encodes it as index.json."""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Self

from cryptography.x509 import ReasonFlags
from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    ValidationError,
    model_validator,
)

from plr.protos.base.errors import ConfigError
from plr.protos.model.names import node_name
from plr.protos.program.config_file import key_path
from plr.protos.trust.identity import IdentityRole

if TYPE_CHECKING:
    from collections.abc import Iterable
    from pathlib import Path

    from plr.protos.model.ids import NodeName


LAST_MOMENT = 253_402_300_799.0
"""The last second of the year 9999 (seconds since 1970), at which a certificate may end (RFC 5280)."""

MAX_CRL_NUMBER = (1 << 159) - 1
"""Largest number that fits 20 octets (RFC 5280)."""

MAX_SERIAL = (1 << 159) - 1
"""The same limit; serial numbers are above 0."""

_REASONS = frozenset(reason.value for reason in ReasonFlags)


@dataclass(frozen=True, slots=True)
class Entry:
    """One certificate; times in seconds since 1970."""

    name: NodeName
    role: IdentityRole
    serial: int
    not_before: float
    not_after: float
    revoked_at: float | None = None
    reason: str = ""
    key: str = ""
    """The key's fingerprint; empty if an older version issued the certificate."""

    def in_force(self, now_wall: float) -> bool:
        """Return whether the certificate is neither revoked nor expired."""
        return self.revoked_at is None and now_wall <= self.not_after


@dataclass(frozen=True, slots=True)
class Record:
    """The history of one CA: its certificate's serial number, its last revocation list's number, what it issued."""

    serial: int
    crl_number: int
    entries: tuple[Entry, ...]
    published_at: float | None = None
    """When the revocation list was last signed, with or without anything new; None if no time is recorded."""
    past: tuple[Entry, ...] = ()
    """Certificates of former CAs that are no longer trusted: a revoked key among them stays refused."""


def _number(text: object) -> int:
    if not isinstance(text, str):
        raise ValueError("expected a hexadecimal number in quotes")
    number = int(text, 16)
    if not 0 < number <= MAX_SERIAL:
        raise ValueError("expected a serial number: above 0, of at most 20 octets")
    return number


_Serial = Annotated[int, BeforeValidator(_number)]
"""Serial number as hexadecimal text: other JSON readers do not keep the 160 bits of such a number."""

_Name = Annotated[str, AfterValidator(lambda text: node_name(text, "the name"))]


_Time = Annotated[float, Field(ge=0.0, le=LAST_MOMENT, allow_inf_nan=False)]


class _EntryRow(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")

    name: _Name
    role: IdentityRole
    serial: _Serial
    not_before: _Time
    not_after: _Time
    revoked_at: _Time | None = None
    reason: str = ""
    key: str = ""

    @model_validator(mode="after")
    def _revoked_for_a_reason(self) -> Self:
        if self.revoked_at is not None and self.reason not in _REASONS:
            raise ValueError(f"expected a reason with revoked_at, one of {', '.join(sorted(_REASONS))}")
        return self

    def entry(self) -> Entry:
        return Entry(
            name=node_name(self.name, "the name"),
            role=self.role,
            serial=self.serial,
            not_before=self.not_before,
            not_after=self.not_after,
            revoked_at=self.revoked_at,
            reason=self.reason,
            key=self.key,
        )


class _RecordRow(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")

    serial: _Serial
    crl_number: int = Field(ge=0, le=MAX_CRL_NUMBER)
    published_at: _Time | None = None
    entries: tuple[_EntryRow, ...]
    past: tuple[_EntryRow, ...] = ()


class _Index(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")

    authorities: tuple[_RecordRow, ...] = Field(min_length=1)
    """The CA that issues, then the former ones, newest first."""


def encode_index(records: Iterable[Record]) -> bytes:
    """Return the file's content."""
    rows = [
        {
            "serial": f"{record.serial:x}",
            "crl_number": record.crl_number,
            "published_at": record.published_at,
            "entries": [_row(entry) for entry in record.entries],
            "past": [_row(entry) for entry in record.past],
        }
        for record in records
    ]
    return json.dumps({"authorities": rows}, indent=1).encode() + b"\n"


def _row(entry: Entry) -> dict[str, object]:
    return {
        "name": entry.name,
        "role": entry.role.value,
        "serial": f"{entry.serial:x}",
        "not_before": entry.not_before,
        "not_after": entry.not_after,
        "revoked_at": entry.revoked_at,
        "reason": entry.reason,
        "key": entry.key,
    }


def decode_index(data: bytes, path: Path) -> tuple[Record, ...]:
    """Return the records of the CAs, the issuing one first; raises ConfigError, which names `path`."""
    try:
        index = _Index.model_validate_json(data)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        raise ConfigError(str(path), key_path(first["loc"]), f"not what plr ca wrote: {first['msg']}") from error
    return tuple(
        Record(
            row.serial,
            row.crl_number,
            tuple(entry.entry() for entry in row.entries),
            row.published_at,
            tuple(entry.entry() for entry in row.past),
        )
        for row in index.authorities
    )
