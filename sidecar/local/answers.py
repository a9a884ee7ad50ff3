"""Checks a sidecar's answers for the client: an answer that does not fit was written by something else.

Keys may be missing in the answer of another version, except those that identify an entry. Keys and parts that are
unknown here are left out.
"""

from __future__ import annotations

import json
from functools import cache
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError

from plr.protos.base.errors import DecodeError
from plr.protos.program.config_file import key_path

Text = Annotated[str, Field(max_length=4096)]
Whole = Annotated[int, Field(ge=-(1 << 63), le=(1 << 63) - 1)]
Address = Annotated[list[Text | Whole], Field(min_length=2, max_length=2)]
"""Host and port."""
Line = dict[str, Any]
"""The keys of `_Line` that are present."""


class _Entry(BaseModel):
    """Base of all entries. A key with a default may be missing, and is then missing here too."""

    model_config = ConfigDict(strict=True, allow_inf_nan=False, frozen=True)


class _Line(_Entry):
    """The frame of every line."""

    id: Whole | None = None
    part: Text = ""
    value: Any = None
    """The content of that part."""
    end: bool = False
    error: Text = ""
    busy: bool = False


class _Node(_Entry):
    protocol: Whole = 0
    name: Text = ""
    role: Text = ""
    version: Text = ""
    python: Text = ""
    pid: Whole = 0
    user: Whole | None = None
    up_s: float = 0.0
    insecure: bool = False
    stun: bool = True
    stun_servers: list[Text] = []
    ros_problem: Text = ""
    left_out_peers: list[Text] = []
    environment: dict[Text, Text] = {}


class _Clock(_Entry):
    floor: float = 0.0


class _TermProblem(_Entry):
    in_force: bool
    text: Text


class _RefusedFiles(_Entry):
    start: bool
    text: Text


class _RevocationList(_Entry):
    number: Whole
    signed_at: float


class _Certificate(_Entry):
    name: Text
    role: Text
    not_after: float
    directory: Text = ""
    serial: Text = ""
    not_before: float = 0.0
    judged_at: float = 0.0
    problem: _TermProblem | None = None
    refused: _RefusedFiles | None = None
    revocation_lists: list[_RevocationList] = []


class _Stun(_Entry):
    family: Whole
    mapping: Address | None = None
    server: Address | None = None
    answered_s: float | None = None
    changes: Whole = 0
    problem: Text | None = None


class _Interface(_Entry):
    name: Text
    suspended: bool = False
    addresses: list[Text] = []
    port: Whole = 0
    mtu: Whole = 0
    bound_to: Text = ""
    hangs: Whole = 0
    stun_families: list[Whole] = []
    stun: list[_Stun] = []


class _Control(_Entry):
    names: list[Text] = []
    connected: bool = False
    since_s: float = 0.0
    way: Text | None = None
    interface: Text | None = None
    last_failure: Text | None = None
    retry_in_s: float | None = None


class _Conflict(_Entry):
    service: Text
    server: Text
    type: Text


class _Services(_Entry):
    carried: dict[Text, Text] = {}
    left_alone: dict[Text, list[Text]] = {}
    missing_types: dict[Text, Text] = {}
    unmet: list[Text] = []
    mismatched: list[Text] = []
    silent: list[Text] = []
    unreached: dict[Text, Whole] = {}
    configured: list[Text] = []
    conflicts: list[_Conflict] = []


class _Mapping(_Entry):
    version: Whole = 0
    source: Text | None = None
    age_s: float | None = None


class _Pair(_Entry):
    interface: Text
    server: Text


class _Mapped(_Entry):
    service: Text
    pairs: list[_Pair]
    predicted_miss: float | None = None
    reason: Text = ""
    deadline_s: float | None = None


class _Ways(_Entry):
    service: Text
    paths: list[_Pair]


class _RefusedPeer(_Entry):
    name: Text
    why: Text


class _RemovedPeer(_Entry):
    name: Text
    since_s: float
    reason: Text | None = None
    kept: Text | None = None
    dormant_s: float | None = None
    heard: bool = False


class _RemovedCounts(_Entry):
    path: Whole = 0
    dormant: Whole = 0
    forgotten: Whole = 0
    at_least: bool = False


class _Gone(_Entry):
    interface: Text
    peer: Text
    since_s: float
    reason: Text


class _Recent(_Entry):
    window_s: float
    sent: Whole
    lost: Whole


class _Path(_Entry):
    interface: Text
    peer: Text
    remote: Whole
    state: Text
    address: Address | None = None
    candidates: Whole = 0
    since_s: float | None = None
    reason: Text | None = None
    rtt_s: float | None = None
    sent: Whole = 0
    lost: Whole = 0
    recent: _Recent | None = None
    max_datagram: Whole = 0
    proven_s: float = 0.0
    rests: bool = False


class _PathName(_Entry):
    interface: Text
    remote: Whole


class _Pong(_Entry):
    interface: Text
    remote: Whole
    rtt_s: Annotated[float, Field(ge=0)]
    problem: Text


_KINDS: dict[str, Any] = {
    "node": _Node,
    "clock": _Clock,
    "certificate": _Certificate,
    "interfaces": _Interface,
    "idle": list[Text],
    "unopened": dict[Text, Text],
    "control": _Control,
    "services": _Services,
    "mapping": _Mapping,
    "mapped": list[_Mapped],
    "ways": list[_Ways],
    "refused_peers": list[_RefusedPeer],
    "removed_peers": list[_RemovedPeer],
    "removed_counts": _RemovedCounts,
    "gone": list[_Gone],
    "paths": list[_Path],
    "pinged": list[_PathName],
    "pong": _Pong,
}


def decode_line(line: bytes) -> Line | None:
    """Return a line's content; None if its part is unknown here. Raises DecodeError."""
    try:
        said: Line = _checked("", json.loads(line))
        part = said.get("part", "")
        if not part:
            return said
        if part not in _KINDS:
            return None
        return {**said, "value": _checked(part, said.get("value"))}
    except ValidationError as error:
        first = error.errors(include_url=False, include_input=False, include_context=False)[0]
        raise DecodeError(f"{key_path(first['loc']) or 'a line'}: {first['msg']}") from None
    except (ValueError, RecursionError) as error:
        raise DecodeError("a line is not JSON") from error


def _checked(part: str, value: Any) -> Any:
    adapter = _adapter(part)
    return adapter.dump_python(adapter.validate_python(value), exclude_unset=True)


@cache
def _adapter(part: str) -> TypeAdapter[Any]:
    """Return the checker for the value of a part; for the frame itself if `part` is empty."""
    return TypeAdapter(_KINDS[part] if part else _Line)
